"""What the prior weight of a run does, as figures: ``python -m recipes.show_weight``."""
