"""Puts a simulator at a recovery point: prefix replay, the handoff check, snapshots, rollback."""
