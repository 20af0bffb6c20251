"""Reproducing a published score: the initial arm first, and the recovery arm where that one is right."""

from lerobot_roborecover.reproduce.arms import ReproductionPlan, run_arms
from lerobot_roborecover.reproduce.record import write_record
from lerobot_roborecover.reproduce.scores import PublishedCheckpoint, find_checkpoint, known_names

__all__ = [
    "PublishedCheckpoint",
    "ReproductionPlan",
    "find_checkpoint",
    "known_names",
    "run_arms",
    "write_record",
]
