"""Data for monitors: which frames, rendered from which continuations."""
