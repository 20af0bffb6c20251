"""What the pages of `annotate` and `teleop` share: who may ask, and a server on this machine alone."""
