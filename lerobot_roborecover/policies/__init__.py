"""Loads policies and runs them in batches: a LeRobot checkpoint, a remote policy, or the composite policy
of an intervention."""
