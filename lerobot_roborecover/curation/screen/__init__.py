"""Screening by policies: which scenarios are of intermediate difficulty."""
