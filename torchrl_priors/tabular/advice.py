"""The priors of the tabular study: a Q-learning teacher, degraded at random or in some states, as look-up tables."""

from __future__ import annotations

import re
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_priors.degradation import StructuralDegradation
from torchrl_priors.priors import ActionPrior, BoltzmannPrior
from torchrl_priors.random import derive_key, uniform
from torchrl_priors.tabular.actor_critic import ADVICE_WIDTH

__all__ = ["PriorSpec", "advice_tables", "parse_prior", "sample_degraded"]


class PriorSpec(NamedTuple):
    """A prior of the study by its parts.

    Attributes:
        random: probability that the adversary answers at a visited step.
        structural: number of states where the adversary always answers.
    """

    random: float = 0.0
    structural: int = 0


def parse_prior(name: str) -> PriorSpec:
    """Read the name of a prior: ``expert``, ``random_<percent>`` or ``structural_<states>``.

    Raises:
        ValueError: the name is none of these.

    Examples:
        >>> parse_prior("random_15"), parse_prior("structural_3")
        (PriorSpec(random=0.15, structural=0), PriorSpec(random=0.0, structural=3))
    """
    if name == "expert":
        return PriorSpec()
    match = re.fullmatch(r"(random|structural)_([1-9]\d*)", name)
    if match and match[1] == "random" and int(match[2]) <= 100:
        return PriorSpec(random=int(match[2]) / 100)
    if match and match[1] == "structural":
        return PriorSpec(structural=int(match[2]))
    raise ValueError(f"Unknown prior {name!r}: expected expert, random_<percent> or structural_<states>.")


def sample_degraded(q: Tensor, visited: Tensor, seeds: Tensor, count: int, temperature: float) -> Tensor:
    """States to degrade: drawn from softmax(max_a Q / temperature) over the visited ones until ``count`` are distinct.

    Drawing until enough distinct ones are found is drawing without replacement, which the Gumbel top-k trick does in
    one go. A world with fewer visited states gets them all.

    Args:
        q (Tensor): action values, ``[W, C, 4]``.
        visited (Tensor): bool, ``[W, C]``.
        seeds (Tensor): int64 ``[W]``, one a world.
        count (int): how many.
        temperature (float): of the softmax, in the unit of the values.

    Returns:
        Tensor: bool, ``[W, C]``.

    Examples:
        >>> q = torch.zeros(1, 3, 4)
        >>> sample_degraded(q, torch.tensor([[True, False, True]]), torch.tensor([0]), 2, 1.0)
        tensor([[ True, False,  True]])
    """
    if not torch.isfinite(q).all():
        raise ValueError("The action values contain NaN or infinite entries.")
    key = derive_key(seeds, "degraded", count).unsqueeze(-1)
    draw = uniform(key, torch.arange(q.shape[1], device=q.device))[0]
    gumbel = -(-(draw + 2.0**-25).log()).log()
    score = torch.where(visited, q.max(-1).values / temperature + gumbel, -torch.inf)
    chosen = torch.zeros_like(visited).scatter_(1, score.topk(min(count, q.shape[1]), -1).indices, True)
    return chosen & visited


def advice_tables(q: Tensor, degraded: dict[int, Tensor], temperature: float) -> Tensor:
    """Log-probabilities of every prior in every state: the expert, its adversary, then each structural degradation.

    Args:
        q (Tensor): action values, ``[W, C, 4]``.
        degraded (dict): bool masks ``[W, C]`` by number of states.
        temperature (float): of the Boltzmann policy.

    Returns:
        Tensor: float32 ``[W * (2 + len(degraded)) * C * 8]``, as :func:`~torchrl_priors.tabular.actor_critic.advance`
        takes it; a world's tables lie together.
    """
    worlds, states = q.shape[:2]
    expert = BoltzmannPrior(q, temperature)
    everywhere = TensorDict(
        {"state": torch.arange(states, device=q.device).expand(worlds, -1)}, [worlds, states], device=q.device
    )
    priors: list[ActionPrior] = [expert, expert.adversary()]
    priors += [StructuralDegradation(expert, mask) for mask in degraded.values()]
    none = torch.zeros(worlds, states, dtype=torch.bool, device=q.device)
    table = torch.zeros(worlds, len(priors), states, ADVICE_WIDTH, device=q.device)
    for index, (prior, mask) in enumerate(zip(priors, [none, none, *degraded.values()], strict=True)):
        table[:, index, :, :4] = prior.get_dist(everywhere).logits  # type: ignore[attr-defined]
        table[:, index, :, 4] = mask
    return table.flatten()
