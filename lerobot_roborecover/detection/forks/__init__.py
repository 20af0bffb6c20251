"""Forks: from a step of a logged trial, what would have come of it had somebody stepped in."""
