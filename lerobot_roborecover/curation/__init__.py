"""From whole rollouts to scenario sets: collect, annotate, resolve, screen, validate, split, donors."""
