"""Detectors of failures: training data, evaluation on recorded trials, counterfactual rollouts (`fork`)."""
