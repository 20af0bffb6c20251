"""Forks: counterfactual rollouts that branch from a step of a logged trial, with and without intervention."""
