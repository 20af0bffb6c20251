"""Detectors, measured side by side on trials of the policy that they watch."""
