"""The methods by name: each is a preset of four settings, not a code path of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["METHODS", "MethodSpec", "get_method"]


@dataclass(frozen=True)
class MethodSpec:
    """What a method does with a prior.

    Attributes:
        bonus: which log-probability enters the reward: ``"none"``, ``"current"`` (log pi0(a_t|s_t)) or ``"next"``
            (log pi0(a_{t+1}|s_{t+1})).
        auxiliary: whether the cross-entropy H^X(pi || pi0) is added to the policy loss.
        adaptive: whether both are scaled by a learned prior weight w(s) (else w = 1).
        weight_target: what the prior weight regresses on: the critic's ``"td"`` error (the paper) or the
            ``"advantage"``.
    """

    bonus: Literal["none", "current", "next"]
    auxiliary: bool
    adaptive: bool
    weight_target: Literal["td", "advantage"] = "td"


METHODS: dict[str, MethodSpec] = {
    "none": MethodSpec(bonus="none", auxiliary=False, adaptive=False),
    # Centa & Preux; er and e2r after Czarnecki et al., "Distilling Policy Distillation" (2019)
    "er": MethodSpec(bonus="current", auxiliary=False, adaptive=False),
    "e2r": MethodSpec(bonus="next", auxiliary=True, adaptive=False),
    "aer": MethodSpec(bonus="current", auxiliary=False, adaptive=True),
    "ae2r": MethodSpec(bonus="next", auxiliary=True, adaptive=True),
    # beyond the paper
    "kickstart": MethodSpec(bonus="none", auxiliary=True, adaptive=False),
    "aligned": MethodSpec(bonus="none", auxiliary=True, adaptive=True, weight_target="advantage"),
}


def get_method(name: str) -> MethodSpec:
    """The settings of a method by name.

    Raises:
        ValueError: the name is unknown; the message lists those that are.

    Examples:
        >>> get_method("ae2r").bonus
        'next'
    """
    try:
        return METHODS[name]
    except KeyError:
        raise ValueError(f"Unknown method {name!r}: expected one of {', '.join(METHODS)}.") from None
