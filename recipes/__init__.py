"""Experiments with soft action priors, run from the command line."""
