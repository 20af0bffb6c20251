"""Policies as the fast runner holds them: what a host offers, and the host of a LeRobot checkpoint."""
