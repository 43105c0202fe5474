"""What the figures share: sizes, fonts, a colour and a name per method, panels, saving."""

from __future__ import annotations

import functools
import io
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from torchrl_priors.atomic import write_atomically
from torchrl_priors.methods import METHODS

__all__ = ["method_color", "method_label", "prior_label", "save_figure"]

P = ParamSpec("P")
T = TypeVar("T")

TEXT_WIDTH = 7.0
"""Inches: both columns of the usual conference page."""

COLUMN_WIDTH = 3.3
"""Inches: one column."""

# Fonts that come with matplotlib, so that a figure looks the same wherever it is made.
STYLE: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": "0.3",
    "axes.grid": True,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlepad": 4,
    "axes.titlesize": 8.5,
    "axes.unicode_minus": True,
    "figure.facecolor": "white",
    "font.family": "STIXGeneral",
    "font.size": 8,
    "grid.color": "0.9",
    "grid.linewidth": 0.5,
    "hatch.linewidth": 0.6,
    "legend.borderaxespad": 0.2,
    "legend.borderpad": 0.2,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "mathtext.fontset": "stix",
    "pdf.fonttype": 42,
    "savefig.facecolor": "white",
    "xtick.color": "0.3",
    "xtick.labelcolor": "black",
    "xtick.labelsize": 7.5,
    "xtick.major.size": 2.5,
    "xtick.major.width": 0.6,
    "ytick.color": "0.3",
    "ytick.labelcolor": "black",
    "ytick.labelsize": 7.5,
    "ytick.major.size": 2.5,
    "ytick.major.width": 0.6,
}

BASELINE = "none"

#: The trial is no method of a loss: the recipe's name for finding out which one to use.
_METHODS = {name: (spec.label, spec.color) for name, spec in METHODS.items()} | {"trial": ("Trial", "#117733")}
_UNNAMED = ("", "")
_OTHER_COLORS = ("#44AA99", "#DDCC77", "#AA4499", "#661100")


def method_label(name: str) -> str:
    """The name of a method as it is printed; a name that isn't known is printed as it is.

    Examples:
        >>> method_label("ae2r"), method_label("mine")
        ('AE2R', 'mine')
    """
    return _METHODS.get(name, _UNNAMED)[0] or name


def method_color(name: str) -> str:
    """The colour of a method, the same in every figure, also for methods that aren't known.

    Examples:
        >>> method_color("none"), method_color("ae2r")
        ('#000000', '#0072B2')
    """
    return _METHODS.get(name, _UNNAMED)[1] or _OTHER_COLORS[sum(name.encode()) % len(_OTHER_COLORS)]


def prior_label(name: str) -> str:
    """The name of a prior as it is printed: ``random_<percent>`` and ``structural_<states>`` are spelled out.

    Examples:
        >>> prior_label("expert"), prior_label("random_15"), prior_label("structural_3"), prior_label("Hopper-v4")
        ('Expert prior', 'Random, 15%', 'Structural, 3 states', 'Hopper-v4')
    """
    kind, _, amount = name.rpartition("_")
    if kind == "random" and amount.isdigit():
        return f"Random, {amount}%"
    if kind == "structural" and amount.isdigit():
        return f"Structural, {amount} state{'' if amount == '1' else 's'}"
    return "Expert prior" if name == "expert" else name


def paper_style(function: Callable[P, T]) -> Callable[P, T]:
    """Run a function under the style of the figures, and put matplotlib's settings back afterwards."""

    @functools.wraps(function)
    def styled(*args: P.args, **kwargs: P.kwargs) -> T:
        with mpl.rc_context(STYLE):
            return function(*args, **kwargs)

    return styled


def new_figure(width: float, height: float) -> Figure:
    """A figure that pyplot doesn't know of, laid out without overlaps."""
    return Figure(
        figsize=(width, height), layout=ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03, wspace=0.03, hspace=0.03)
    )


def line_style(method: str) -> dict[str, Any]:
    """The line of a method; the baseline is dashed, and drawn above the others."""
    baseline = method == BASELINE
    return {
        "color": method_color(method),
        "linestyle": (0, (3.5, 1.5)) if baseline else "-",
        "linewidth": 1.1 if baseline else 1.3,
        "zorder": 4 if baseline else 3,
    }


def thousands(value: float, _position: int | None = None) -> str:
    """Tick labels of step counts: 30000 is 30k, 1500000 is 1.5M."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{unit}"
    return f"{value:g}"


def outer_labels(axes: dict[tuple[int, int], Axes], xlabel: str, ylabel: str, share_y: bool) -> None:
    """Label the x axis of the lowest panel of each column, and the y axis of the first of each row.

    Panels that share their y axis have its ticks labelled in the columns where a row begins only.
    """
    first = {min(c for r, c in axes if r == row) for row, _ in axes}
    for (row, column), ax in axes.items():
        if not any(c == column and r > row for r, c in axes):
            ax.set_xlabel(xlabel)
        if not any(r == row and c < column for r, c in axes):
            ax.set_ylabel(ylabel)
        ax.tick_params(labelleft=not share_y or column in first)


@paper_style
def save_figure(
    figure: Figure, path: str | os.PathLike[str], *, formats: Sequence[str] = ("pdf", "png"), dpi: int = 300
) -> list[Path]:
    """Save a figure, cropped tightly, once per format; the same figure gives the same bytes at any time of any day.

    Each file is complete or absent: it is written beside its place and then moved there.

    Args:
        figure (Figure): the figure.
        path (path-like): where to, without suffix; missing folders are made.

    Keyword Args:
        formats (sequence of str): suffixes. Defaults to ``("pdf", "png")``.
        dpi (int): resolution of bitmaps. Defaults to 300.

    Returns:
        list of Path: the files, in the order of ``formats``.

    Raises:
        OSError: the folder can't be written.
        ValueError: matplotlib doesn't know a format.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     [file.name for file in save_figure(Figure(), f"{folder}/figures/empty")]
        ['empty.pdf', 'empty.png']
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    written = []
    for suffix, content in zip(formats, _pictures(figure, formats, dpi), strict=True):
        file = target.with_name(f"{target.name}.{suffix}")
        write_atomically(file, content)
        written.append(file)
    return written


def _pictures(figure: Figure, formats: Sequence[str], dpi: int) -> Iterator[bytes]:
    """The content of the files, one by one. Layout and crop, which take as long as the rest, are found once for all."""
    undated: dict[str, dict[str, Any]] = {
        "pdf": {"CreationDate": None},
        "svg": {"Date": None},
        "png": {"Software": None},
    }
    figure.draw_without_rendering()
    crop = figure.get_tightbbox().padded(0.03)
    engine = figure.get_layout_engine()
    figure.set_layout_engine("none")
    try:
        for suffix in formats:
            buffer = io.BytesIO()
            with mpl.rc_context({"svg.hashsalt": "torchrl_priors"}):
                figure.savefig(buffer, format=suffix, dpi=dpi, bbox_inches=crop, metadata=undated.get(suffix))
            yield buffer.getvalue()
    finally:
        figure.set_layout_engine(engine)
