"""Shares of the runs of a method that are harmed by their teacher, or that get worse as training goes on."""

from __future__ import annotations

import numpy as np
import pandas as pd

from recipes.metrics import share_of_runs
from recipes.report.tables import ALL, Study, change

__all__ = ["BELOW", "LOWER", "share_table"]

BELOW, LOWER = "below_baseline", "lower_at_the_end"


def share_table(study: Study) -> pd.DataFrame:
    """Shares per environment and over all of them; those of all count every run alike."""
    rows = []
    panels = [([env], prior) for env, prior in study.panels()]
    envs = {prior: [env for env, other in study.panels() if other == prior] for prior in study.priors}
    panels += [(chosen, prior) for prior, chosen in envs.items() if len(chosen) > 1]
    for chosen, prior in panels:
        for label in study.labels:
            ratios = [ratio for env in chosen for ratio in study.ratios(env, prior, label).values()]
            changes = [change(study, run) for env in chosen for run in study.runs(env, prior, label)]
            found = {LOWER: np.array(changes) < 0}
            if label != study.cfg.baseline:
                found[BELOW] = np.array(ratios) < 0
            rows += [
                (chosen[0] if len(chosen) == 1 else ALL, prior, label, what, len(hits), int(hits.sum()), *share)
                for what, hits in found.items()
                if len(hits)
                for share in [share_of_runs(hits, confidence=study.cfg.bootstrap.confidence)]
            ]
    columns = ["env", "prior", "method", "what", "runs", "count", "share", "ci_low", "ci_high"]
    return pd.DataFrame(rows, columns=columns)
