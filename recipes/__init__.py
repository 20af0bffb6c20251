"""How the shipped sets, policies and studies were made: run from a clone, not installed."""
