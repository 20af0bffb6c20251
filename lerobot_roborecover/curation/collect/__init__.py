"""Rollouts become candidates: starts, controllers, perturbation, recording, exclusions."""
