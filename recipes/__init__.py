"""How the shipped sets, policies and studies were made: run from a clone, not installed."""

from lerobot_roborecover.rounding import pin_rounding

pin_rounding()  # before anything here imports numpy
