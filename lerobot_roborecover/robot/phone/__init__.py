"""The page on a phone at the robot: the ghost, the buttons, and what serves them."""
