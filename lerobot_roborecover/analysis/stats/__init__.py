"""Estimates, intervals and tests: numpy alone; nothing is drawn here, and no file is written."""
