"""The web pages on which people annotate and drive, and what serves them on this machine alone."""
