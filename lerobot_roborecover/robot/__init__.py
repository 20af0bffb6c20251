"""Real robots: recovery points of recorded episodes, putting robot and scene back to them, and scored trials.

Everything runs on LeRobot's own `Robot`s; `lab/` has one that is simulated.
"""
