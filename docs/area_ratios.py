"""The directive ``area-ratios``: a table of the grid worlds' results for the methods that it names."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

RESULTS = Path(__file__).parents[1] / "results" / "gridworld"
STUDIES = ("original", "shaped", "beyond", "comparisons")


class AreaRatios(SphinxDirective):
    """IQM of the area ratio × 1000 and its interval, for each study that has the method."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """The table, made by the parser of the page."""
        return self.parse_text_to_nodes(area_ratios(self.arguments[0].split(", ")))


def area_ratios(methods: list[str]) -> str:
    """The table as Markdown.

    Raises:
        ValueError: no study has any of the methods.
    """
    found: dict[tuple[str, str], dict[str, str]] = {}
    priors: dict[str, None] = {}
    for study in STUDIES:
        with (RESULTS / study / "area_ratio.csv").open(encoding="utf-8") as file:
            for row in csv.DictReader(file):
                iqm, low, high = (round(1000 * float(row[name])) for name in ("iqm", "ci_low", "ci_high"))
                found.setdefault((study, row["method"]), {})[row["prior"]] = f"{iqm} ({low}, {high})"
                priors[row["prior"]] = None
    for method in {method for study, method in found if study == "beyond"}:
        found.pop(("comparisons", method), None)  # the same worlds and numbers once more
    columns = [(study, method) for method in methods for study in STUDIES if (study, method) in found]
    if not columns:
        raise ValueError(f"No study has the methods {', '.join(methods)}.")
    names = [study if len(methods) == 1 else f"{method}, {study}" for study, method in columns]
    lines = ["| prior | " + " | ".join(names) + " |", "|---" + "|---:" * len(names) + "|"]
    lines += [
        "| " + " | ".join([prior, *(found[column].get(prior, "") for column in columns)]) + " |" for prior in priors
    ]
    return "\n".join(lines)


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_directive("area-ratios", AreaRatios)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
