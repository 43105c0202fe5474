"""A policy of the MuJoCo experiments as a prior."""

from __future__ import annotations

from typing import Any

from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor

from torchrl_priors.collectors.running_norm import RunningNorm
from torchrl_priors.networks import GaussianMLP
from torchrl_priors.priors.layers import TeacherInput
from torchrl_priors.priors.module import ModulePrior


def policy_prior(
    actor: ProbabilisticActor,
    normalizer: RunningNorm | None,
    *,
    in_key: NestedKey = "observation",
    namespace: NestedKey = "prior",
) -> ModulePrior:
    """A policy of :func:`~torchrl_priors.networks.make_actor` and the statistics it was trained with as a teacher.

    It reads raw observations and normalises them by its own statistics as they are now, whatever the student does to
    its own. :func:`~torchrl_priors.artifacts.save_prior` writes it to a file.

    Args:
        actor (ProbabilisticActor): from :func:`~torchrl_priors.networks.make_actor`.
        normalizer (RunningNorm, optional): the statistics of raw observations ``[obs_dim]``. ``None`` for a policy that
            was trained on raw observations.

    Keyword Args:
        in_key (NestedKey): *raw* observations ``[*B, obs_dim]``. Defaults to ``"observation"``.
        namespace (str or tuple of str): as in :class:`ActionPrior`.

    Raises:
        TypeError: the actor is not one of :func:`~torchrl_priors.networks.make_actor`, or the normalizer no
            RunningNorm.
        ValueError: the statistics are of another shape than the observations of the actor.

    Examples:
        >>> from torchrl_priors.networks import make_actor
        >>> prior = policy_prior(make_actor(17, 6), RunningNorm(17))
        >>> prior.in_keys, prior.out_keys
        (['observation'], [('prior', 'loc'), ('prior', 'scale')])
    """
    net = _find_net(actor)
    discrete = isinstance(net, MLP)
    obs_dim = net.in_features if discrete else net.obs_dim
    first: nn.Module
    if normalizer is None:
        first = TeacherInput((obs_dim,), flatten=False)
    elif not isinstance(normalizer, RunningNorm):
        raise TypeError(f"The statistics of a policy are those of a RunningNorm, got {type(normalizer).__name__}.")
    elif tuple(normalizer.shape) != (obs_dim,):
        raise ValueError(
            f"The policy reads observations of shape ({obs_dim},), and its statistics are of shape"
            f" {tuple(normalizer.shape)}."
        )
    else:
        first = normalizer
    return ModulePrior(
        nn.Sequential(first, net), "logits" if discrete else "mean_std", in_keys=[in_key], namespace=namespace
    )


def _find_net(actor: ProbabilisticActor) -> Any:
    """The network of an actor of :func:`~torchrl_priors.networks.make_actor`, if it is one and nothing else."""
    modules = list(actor.modules())
    nets = [module for module in modules if isinstance(module, GaussianMLP)]
    kind: Any = IndependentNormal
    if not nets:
        nets, kind = [module for module in modules if isinstance(module, MLP)], Categorical
    heads = [module for module in modules if isinstance(module, ProbabilisticTensorDictModule)]
    if (
        len(nets) != 1
        or len(heads) != 1
        or heads[0].distribution_class is not kind
        or heads[0].distribution_kwargs
        or len(list(actor.state_dict())) != len(nets[0].state_dict())
    ):
        raise TypeError(
            f"Expected an actor of torchrl_priors.networks.make_actor, got a {type(actor).__name__} with {len(nets)}"
            " such networks and other parts. A ModulePrior takes any network, and an ActionPrior any actor."
        )
    return nets[0]
