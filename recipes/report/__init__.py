"""Tables, figures and pages from finished runs: ``python -m recipes.report``."""
