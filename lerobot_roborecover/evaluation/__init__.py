"""Evaluates policies: one trial, the session of a run, the scheduler that fills batches, the
environments that LeRobot creates, and `evaluate()`."""
