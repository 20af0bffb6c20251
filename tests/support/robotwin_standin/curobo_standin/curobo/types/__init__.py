"""A stand-in for curobo: what the stand-in tasks import of it."""
