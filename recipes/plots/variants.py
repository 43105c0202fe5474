"""Variants of a method, as in ``"ae2r Cω=0.03"``: its colour, in a lighter shade and another dash for each."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from matplotlib.colors import to_hex, to_rgb

from recipes.plots.style import BASELINE, line_style, method_label

__all__ = ["variant_label", "variant_styles"]

_DASHES: tuple[Any, ...] = ("-", (0, (4, 1.2)), (0, (1.2, 1.2)), (0, (5, 1.2, 1.2, 1.2)))


def variant_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """The line of each method and variant; variants of a method follow each other from dark to light.

    Examples:
        >>> styles = variant_styles(["e2r", "ae2r Cω=1", "ae2r Cω=0.03"])
        >>> [style["color"] for style in styles.values()]
        ['#d55e00', '#0072b2', '#66aad1']
    """
    names = list(dict.fromkeys(names))
    styles = {}
    for name in names:
        family = [other for other in names if _base(other) == _base(name)]
        place = family.index(name)
        light = 0.55 * place / max(1, len(family) - 1) if len(family) > 2 else 0.4 * place
        red, green, blue = (part * (1 - light) + light for part in to_rgb(line_style(_base(name))["color"]))
        style = {**line_style(_base(name)), "color": to_hex((red, green, blue))}
        if _base(name) != BASELINE:
            style["linestyle"] = _DASHES[place % len(_DASHES)]
        styles[name] = style
    return styles


def variant_label(name: str, baseline: str | None = None) -> str:
    r"""A method and its variant as they are printed; the baseline may have a name of its own.

    Examples:
        >>> variant_label("ae2r Cω=0.03"), variant_label("none", baseline="PPO")
        ('AE2R $C_\\omega$=0.03', 'PPO')
    """
    base, settings = _base(name), name.partition(" ")[2].replace("Cω", r"$C_\omega$")
    shown = baseline if base == BASELINE and baseline else method_label(base)
    return f"{shown} {settings}" if settings else shown


def _base(name: str) -> str:
    return name.partition(" ")[0]
