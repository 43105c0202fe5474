"""The page and figures of a gridworld study, from the tables in its folder, and what is said in the terminal."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from recipes.common.run_folder import write_file
from recipes.metrics import MIN_RUNS, ConfidenceInterval, stratified_bootstrap_ci
from recipes.plots import (
    curve_panels,
    interval_panels,
    method_label,
    prior_label,
    profile_panels,
    save_figure,
)
from recipes.report.markdown import interval, pivot, table

__all__ = ["summary", "write"]

_TABLES = ("area_ratio", "curves", "comparisons", "prior_weights", "worlds")
#: Where the paper has its seven priors: quality falls from left to right.
_PLACES = {
    **{prior: (0, column) for column, prior in enumerate(("expert", "random_15", "random_30", "random_50"))},
    **{prior: (1, column) for column, prior in enumerate(("structural_3", "structural_5", "structural_10"), start=1)},
}
#: Figures of what is in no table: taken from the folder where they are there.
_TAKEN = ("performance_profiles", "world", "prior_weights")


def write(folder: Path, out: Path, profiles: dict[str, np.ndarray] | None = None) -> list[Path]:
    """Write ``report.md`` and its figures into ``out``; their paths, that of the page last.

    Args:
        folder (Path): of the study.
        out (Path): may be that folder.
        profiles (dict, optional): area ratios ``[worlds, priors]`` by method, which no table has.

    Raises:
        ValueError: a table or the configuration is missing, damaged or has holes; the message names its file.
    """
    config = _config(folder / "config.yaml")
    tables = {name: _table(folder / f"{name}.csv", optional=name not in _TABLES[:2]) for name in _TABLES}
    written = []
    for name, figure in _figures(tables, profiles).items():
        written += save_figure(figure, out / name)
    for name in (f"{name}.{suffix}" for name in _TAKEN for suffix in ("pdf", "png")):
        if (folder / name).exists() and folder.resolve() != out.resolve():
            shutil.copyfile(folder / name, out / name)
    return [*written, write_file(out / "report.md", _page(folder, out, config, tables))]


def _config(file: Path) -> dict[str, Any]:
    try:
        config: Any = OmegaConf.to_container(OmegaConf.load(file))
        return {key: config[key] for key in ("worlds", "seed", "td_error")}
    except Exception as error:  # whatever reading a damaged file ends in
        raise ValueError(f"{file} cannot be used ({type(error).__name__}: {error}).") from None


def _table(file: Path, *, optional: bool) -> pd.DataFrame:
    if optional and not file.exists():
        return pd.DataFrame()
    try:
        frame = pd.read_csv(file)
    except FileNotFoundError:
        raise ValueError(f"{file} is missing: is the study finished?") from None
    except (ValueError, OSError) as error:
        raise ValueError(f"{file} is damaged ({error}).") from None
    holes = [name for name in frame if not name.startswith("paper_") and frame[name].isna().any()]
    if holes and not optional:
        raise ValueError(f"{file} has values missing in {', '.join(holes)}.")
    return frame


def _figures(tables: dict[str, pd.DataFrame], profiles: dict[str, np.ndarray] | None) -> dict[str, Figure]:
    ratios, curves = tables["area_ratio"], tables["curves"]
    intervals = _by_prior(ratios, ["iqm", "ci_low", "ci_high"])
    paper = {}
    if "paper_iqm" in ratios:
        paper = _by_prior(ratios.dropna(subset=["paper_iqm"]), ["paper_iqm", "paper_ci_low", "paper_ci_high"])
    lines: dict[str, dict[str, ConfidenceInterval]] = {}
    for (prior, method), rows in curves.groupby(["prior", "method"], sort=False):
        curve = ConfidenceInterval(*rows[["mean", "ci_low", "ci_high"]].to_numpy().T)
        lines.setdefault(prior_label(prior), {})[method] = curve
    steps = dict.fromkeys(lines, curves["transitions"].unique())
    titles = {prior_label(prior): place for prior, place in _PLACES.items()}
    layout: Any = {"places": titles} if set(titles) == set(lines) else {"columns": 4}
    found = {
        "learning_curves": curve_panels(lines, steps, share_y=True, xlabel="Transitions", **layout),
        "iqm": interval_panels(
            intervals, scale=1e3, xlabel=r"IQM of $r_{\pi_0}$ ($\times 10^{-3}$)", reference=paper, **layout
        ),
    }
    if profiles is not None:
        taus = np.linspace(-1, 1, 201)
        bands = {method: _profile(ratios, taus) for method, ratios in profiles.items()}
        found["performance_profiles"] = profile_panels({"All priors": bands}, taus)
    return found


def _profile(ratios: np.ndarray, taus: np.ndarray) -> ConfidenceInterval:
    """The performance profile of ratios ``[worlds, priors]``; all priors of a world have one baseline, so they stay."""
    above = (ratios[..., None] > taus).mean(1)
    band = stratified_bootstrap_ci(above[:, None], np.mean)
    return band if len(ratios) >= MIN_RUNS else band._replace(low=band.estimate, high=band.estimate)


def _by_prior(ratios: pd.DataFrame, columns: list[str]) -> dict[str, dict[str, ConfidenceInterval]]:
    found: dict[str, dict[str, ConfidenceInterval]] = {}
    for _, row in ratios.iterrows():
        found.setdefault(prior_label(row["prior"]), {})[row["method"]] = ConfidenceInterval(*row[columns])
    return found


def _page(folder: Path, out: Path, config: dict[str, Any], tables: dict[str, pd.DataFrame]) -> str:
    level = "IQM over worlds of the area ratio x 1000 (95 % bootstrap interval)"
    parts = [
        f"# Gridworld study: {folder.name}",
        f"{config['worlds']} worlds from seed {config['seed']}, `td_error={config['td_error']}`; "
        "all settings in `config.yaml` of the study's folder.",
        f"```bash\npython -m recipes.report runs={folder} out={out}\n```",
        "## Area ratios",
        level + "; in square brackets what the paper reports.",
        _named(tables["area_ratio"], _ratio),
        "![Area ratios per prior](iqm.png)",
        "## Learning curves",
        "![Learning curves, mean and 95 % band over worlds](learning_curves.png)",
    ]
    if (out / "performance_profiles.png").exists():
        parts.append("![Performance profiles](performance_profiles.png)")
    if len(comparisons := tables["comparisons"]):
        pairs = comparisons.assign(
            method=[
                f"{method_label(a)} - {method_label(b)}"
                for a, b in zip(comparisons["method"], comparisons["reference"], strict=True)
            ]
        )
        parts += [
            "## Methods against each other",
            "Difference of IQMs on the same worlds x 1000:",
            _named(pairs, lambda row: _thousandths(*row[["iqm_difference", "ci_low", "ci_high"]])),
        ]
    if len(weights := tables["prior_weights"]):
        heading = "## Prior weight in evaluation episodes"
        parts += [heading, "Mean and 95 % interval, by resampling worlds:", _weights(weights)]
    return "\n\n".join(parts) + "\n"


def _named(frame: pd.DataFrame, cell: Any) -> str:
    shown = frame.assign(prior=frame["prior"].map(prior_label), method=frame["method"].map(method_label))
    return pivot(shown, ["prior"], cell)


def _ratio(row: pd.Series) -> str:
    paper = f" [{_whole(row['paper_iqm'])}]" if "paper_iqm" in row and pd.notna(row["paper_iqm"]) else ""
    return _thousandths(*row[["iqm", "ci_low", "ci_high"]]) + paper


def _thousandths(*values: float) -> str:
    estimate, low, high = (1000 * value for value in values)
    return interval(estimate, low, high, digits=0)


def _whole(value: float) -> str:
    return f"{1000 * value:.0f}"


def _weights(weights: pd.DataFrame) -> str:
    rows = [
        [
            prior_label(row["prior"]),
            method_label(row["method"]),
            row["average"],
            *(_weight(row, name) for name in ("degraded", "non_degraded", "gap")),
        ]
        for _, row in weights.iterrows()
    ]
    return table(["prior", "method", "average over", "degraded", "non-degraded", "gap"], rows, text_columns=3)


def _weight(row: pd.Series, name: str) -> str:
    return interval(row[name], row[f"{name}_ci_low"], row[f"{name}_ci_high"], digits=3)


def summary(folder: Path) -> str:
    """The main tables for a terminal, in 80 columns whatever the number of methods."""
    config, ratios = _config(folder / "config.yaml"), _table(folder / "area_ratio.csv", optional=True)
    parts = [f"Area ratio x 1000, IQM over {config['worlds']} worlds (95 % CI), td_error={config['td_error']}"]
    lines = [f"{'prior':16}{'method':20}{'here':>20}{'the paper':>20}"]
    for prior, rows in ratios.groupby("prior", sort=False) if len(ratios) else ():
        for row in rows.itertuples():
            here = _cell(row.iqm, row.ci_low, row.ci_high)
            paper = _cell(row.paper_iqm, row.paper_ci_low, row.paper_ci_high)
            lines.append(f"{prior:16}{row.method:20}{here:>20}{paper:>20}".rstrip())
            prior = ""
    parts.append("\n".join(lines))
    if len(weights := _table(folder / "prior_weights.csv", optional=True)):
        lines = [f"{'prior':16}{'method':10}{'degraded':>22}{'other':>22}"]
        for _, row in weights[weights["average"] == "visit"].iterrows():
            cells = "".join(f"{_weight(row, name):>22}" for name in ("degraded", "non_degraded"))
            lines.append(f"{row['prior']:16}{row['method']:10}{cells}")
        parts.append("Prior weight in evaluation episodes, by visit (95 % CI)\n" + "\n".join(lines))
    return "\n\n".join(parts)


def _cell(estimate: float, low: float, high: float) -> str:
    return "" if np.isnan(estimate) else f"{1000 * estimate:.0f} ({1000 * low:.0f}, {1000 * high:.0f})"
