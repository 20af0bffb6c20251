"""The fast runner and `evaluate`, where trials of different scenarios share policy batches and
simulators step while the policy infers."""
