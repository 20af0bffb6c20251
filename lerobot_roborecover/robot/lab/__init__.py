"""A simulated lab: our simulators as a LeRobot robot with cameras, noise, backlash and latency, and an
operator who puts objects back with errors. `--robot.type=roborecover_lab` names it.

Numbers from it are of a simulated lab. The true start error is known here, so what the measures on pictures
say can be compared with it.
"""
