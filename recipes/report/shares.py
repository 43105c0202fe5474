"""Shares of the runs of a method that are harmed by their teacher, or that get worse as training goes on."""

from __future__ import annotations

import numpy as np
import pandas as pd

from recipes.metrics import share_of_runs
from recipes.report.tables import ALL, Study, change

__all__ = ["BELOW", "LOWER", "share_table"]

BELOW, LOWER = "below_baseline", "lower_at_the_end"


def share_table(study: Study) -> pd.DataFrame:
    """Shares per environment, and over all of them for a method that was run in all; there every run counts alike."""
    found: dict[tuple[str, str, str], dict[str, np.ndarray]] = {}
    for env, prior, label, runs in study.groups():
        changes = np.array([change(run, study.cfg.change_from) for run in runs])
        if np.isfinite(changes).all():
            found.setdefault((LOWER, prior, label), {})[env] = changes < 0
    for env, prior in study.panels():
        for label in study.methods(env, prior):
            if label != study.cfg.baseline and (ratios := study.ratios(env, prior, label)):
                found.setdefault((BELOW, prior, label), {})[env] = np.array(list(ratios.values())) < 0
    rows = []
    for (what, prior, label), by_env in found.items():
        envs = study.envs_of(prior) if prior else study.envs
        whole = {ALL: np.concatenate(list(by_env.values()))} if len(envs) > 1 and set(by_env) == set(envs) else {}
        for env, hits in {**by_env, **whole}.items():
            share = share_of_runs(hits, confidence=study.cfg.bootstrap.confidence)
            rows.append((what, env, prior, label, len(hits), int(hits.sum()), *share))
    columns = ["what", "env", "prior", "method", "runs", "count", "share", "ci_low", "ci_high"]
    return pd.DataFrame(rows, columns=columns)
