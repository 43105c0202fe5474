"""Numbers and tables in Markdown."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

__all__ = ["interval", "number", "pivot", "plus_minus", "table"]


def number(value: float, digits: int = 2) -> str:
    """A number as short as it may be: whole from a hundred on, a dash where there is none."""
    if value is None or np.isnan(value):
        return "-"
    text = f"{value:,.0f}".replace(",", " ") if abs(value) >= 100 else f"{value:.{digits}f}"
    return text.lstrip("-") if float(text.replace(" ", "")) == 0 else text


def interval(estimate: float, low: float, high: float, digits: int = 2) -> str:
    """An estimate and its interval, if it has one."""
    if np.isnan(low):
        return number(estimate, digits)
    return f"{number(estimate, digits)} ({number(low, digits)}, {number(high, digits)})"


def plus_minus(mean: float, spread: float, digits: int = 2) -> str:
    """A mean and its standard deviation, if it has one."""
    return number(mean, digits) if np.isnan(spread) else f"{number(mean, digits)} ± {number(spread, digits)}"


def table(columns: Sequence[str], rows: Sequence[Sequence[object]], text_columns: int = 1) -> str:
    """A Markdown table: what is text on the left, what is numbers on the right, a cell's lines as one.

    >>> print(table(["env", "return"], [["Hopper", "1 020"]]))
    | env | return |
    |:--|--:|
    | Hopper | 1 020 |
    """
    rule = "|".join(":--" if index < text_columns else "--:" for index in range(len(columns)))
    lines = [[_cell(cell) for cell in row] for row in (columns, *rows)]
    return "\n".join([f"| {' | '.join(lines[0])} |", f"|{rule}|", *(f"| {' | '.join(line)} |" for line in lines[1:])])


def _cell(content: object) -> str:
    return " ".join(line.strip() for line in str(content).splitlines()).replace("|", "\\|")


def pivot(frame: pd.DataFrame, index: Sequence[str], cell: Callable[[pd.Series], str], columns: str = "method") -> str:
    """A Markdown table with a row per ``index`` and a column per method, in the order they come in."""
    names = list(dict.fromkeys(frame[columns]))
    rows: dict[tuple, dict[str, str]] = {}
    for _, row in frame.iterrows():
        rows.setdefault(tuple(row[name] for name in index), {})[row[columns]] = cell(row)
    body = [[*key, *(cells.get(name, "-") for name in names)] for key, cells in rows.items()]
    return table([*index, *names], body, text_columns=len(index))
