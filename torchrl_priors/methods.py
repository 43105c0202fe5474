"""The methods by name: each is a preset of settings, not a code path of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
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
        relative: whether the bonus is relative to the student's own log-probability, log pi0(a|s) - log pi(a|s): in the
            mean minus the divergence KL(pi || pi0). Of ``bonus="current"`` without a learned weight only.
        cross_entropy: whose actions the auxiliary loss averages over: the ``"student"``'s, H^X(pi || pi0), or the
            ``"teacher"``'s, H^X(pi0 || pi).
        aux_coeff: the coefficient of the auxiliary loss where none is given.
        annealed: whether the method's coefficients are meant to go to 0 over training. Whoever runs the loop does that,
            with a :class:`~torchrl_priors.schedules.CoeffScheduler`; losses and transforms do not read it.
        label: how figures call it. Defaults to ``""``, its name.
        color: of its lines in figures. Defaults to ``""``, one that follows from its name.
    """

    bonus: Literal["none", "current", "next"]
    auxiliary: bool
    adaptive: bool
    weight_target: Literal["td", "advantage"] = "td"
    relative: bool = False
    cross_entropy: Literal["student", "teacher"] = "student"
    aux_coeff: float = 1.0
    annealed: bool = False
    label: str = field(default="", compare=False)
    color: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if self.relative and (self.bonus != "current" or self.adaptive):
            raise ValueError(f"A relative bonus is the current one, without a learned weight: got {self}.")


# Colours are Okabe & Ito's, safe for colour-blind readers: warm without a learned weight, cool with one; then Tol's.
METHODS: dict[str, MethodSpec] = {
    "none": MethodSpec("none", auxiliary=False, adaptive=False, label="Baseline", color="#000000"),
    # Centa & Preux; er and e2r after Czarnecki et al., "Distilling Policy Distillation" (2019)
    "er": MethodSpec("current", auxiliary=False, adaptive=False, label="ER", color="#E69F00"),
    "e2r": MethodSpec("next", auxiliary=True, adaptive=False, label="E2R", color="#D55E00"),
    "aer": MethodSpec("current", auxiliary=False, adaptive=True, label="AER", color="#56B4E9"),
    "ae2r": MethodSpec("next", auxiliary=True, adaptive=True, label="AE2R", color="#0072B2"),
    # beyond the paper
    "kickstart": MethodSpec("none", auxiliary=True, adaptive=False, label="Kickstart", color="#CC79A7"),
    "pull": MethodSpec(
        "none", auxiliary=True, adaptive=False, cross_entropy="teacher", aux_coeff=0.3, label="Pull", color="#332288"
    ),
    "aligned": MethodSpec(
        "none",
        auxiliary=True,
        adaptive=True,
        weight_target="advantage",
        cross_entropy="teacher",
        label="Aligned",
        color="#009E73",
    ),
    # the field's baselines: Schmitt et al., "Kickstarting Deep Reinforcement Learning" (2018), with a schedule in place
    # of population-based training; and the KL penalty in the reward of KL-regularised RL, e.g. Teh et al., "Distral"
    # (2017), Galashov et al., "Information asymmetry in KL-regularized RL" (2019)
    "annealed_kickstart": MethodSpec(
        "none",
        auxiliary=True,
        adaptive=False,
        cross_entropy="teacher",
        annealed=True,
        label="Annealed kickstart",
        color="#882255",
    ),
    "kl_penalty": MethodSpec(
        "current", auxiliary=False, adaptive=False, relative=True, label="KL penalty", color="#999933"
    ),
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
