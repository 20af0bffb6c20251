"""A stand-in for curobo: what RoboTwin's planner and the stand-in tasks import of it. Needs no GPU."""
