"""Rollouts become candidates: starts, drivers, perturbation, recording, exclusions."""
