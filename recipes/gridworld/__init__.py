"""The tabular study on random grid worlds: ``python -m recipes.gridworld``."""
