"""What lerobot-eval sees: env types, the scenario vector env, the life of a trial, the trial log."""
