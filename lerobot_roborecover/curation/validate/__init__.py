"""Replays of screening runs against what was recorded, and the pages to look at."""
