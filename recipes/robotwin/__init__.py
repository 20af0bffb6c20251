"""RoboTwin: the scripted expert, recipes and the shipped set."""
