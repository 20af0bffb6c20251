"""Interventions: the composite policy, Correction, rollback, the monitor, human takeover.

Light: importing this package imports neither LeRobot nor torch.
"""
