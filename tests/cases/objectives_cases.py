"""Small networks and batches that the tests of the losses share."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import distributions as d
from torch import nn
from torchrl.modules import IndependentNormal, OneHotCategorical, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_priors.objectives import AE2RLoss, ClipPPOPriorLoss

OBS, ACTIONS = 3, 2
DISTRIBUTIONS = {
    "categorical": d.Categorical,
    "one_hot": OneHotCategorical,
    "normal": IndependentNormal,
    "tanh_normal": TanhNormal,
}


def make_actor(kind="categorical", observation="observation", action="action", hidden=()):
    layers, width = [], OBS
    for size in hidden:
        layers += [nn.Linear(width, size), nn.Tanh()]
        width = size
    if kind in ("categorical", "one_hot"):
        net, params = nn.Sequential(*layers, nn.Linear(width, ACTIONS)), ["logits"]
    else:
        net, params = (nn.Sequential(*layers, nn.Linear(width, 2 * ACTIONS), NormalParamExtractor()), ["loc", "scale"])
    module = TensorDictModule(net, in_keys=[observation], out_keys=params)
    return ProbabilisticActor(
        module, in_keys=params, out_keys=[action], distribution_class=DISTRIBUTIONS[kind], return_log_prob=True
    )


def make_critic(observation="observation", value="state_value"):
    return ValueOperator(nn.Linear(OBS, 1), in_keys=[observation], out_keys=[value])


def make_weight(observation="observation", weight="prior_weight"):
    net = nn.Sequential(nn.Linear(OBS, 1), nn.Sigmoid())
    return TensorDictModule(net, in_keys=[observation], out_keys=[weight])


class Constant(nn.Module):
    def __init__(self, value):
        super().__init__()
        self.register_buffer("value", torch.tensor(float(value)))

    def forward(self, observation):
        return self.value.expand(*observation.shape[:-1], 1)


def make_constant_weight(value):
    return TensorDictModule(Constant(value), in_keys=["observation"], out_keys=["prior_weight"])


def make_batch(kind="categorical", batch=(6,), observation="observation"):
    """What a rollout looks like after PriorLogProb, PriorBonus and GAE, with terminations; consistent in shape only."""
    actor = make_actor(kind, observation)
    terminated = torch.zeros(*batch, 1, dtype=torch.bool)
    terminated[..., 1, :] = True
    log_prob = -torch.rand(*batch, 1) - 0.1
    data = TensorDict(
        {
            observation: torch.randn(*batch, OBS),
            "prior_log_prob": -torch.rand(*batch, 1) - 0.1,
            "advantage": torch.randn(*batch, 1),
            "value_target": torch.randn(*batch, 1),
            "next": {
                observation: torch.randn(*batch, OBS),
                "reward": torch.randn(*batch, 1),
                "shaped_reward": torch.randn(*batch, 1),
                "prior_bonus": torch.zeros(*batch, 1),  # that of no method in particular
                "terminated": terminated,
                "done": terminated.clone(),
                "prior_log_prob": log_prob.masked_fill(terminated, 0.0),
            },
        },
        batch,
    )
    with torch.no_grad():
        acted = actor(data.select(observation))
    data["action"], data["action_log_prob"] = acted["action"], acted["action_log_prob"]
    return data


def total(losses):
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def gradients(module):
    return {name: None if p.grad is None else p.grad.clone() for name, p in module.named_parameters()}


def same_tensors(first, second):
    """Whether two dictionaries of tensors (or None) are equal, bit by bit."""
    assert first.keys() == second.keys()
    return all(
        (a is None and b is None) or torch.equal(a, b) for a, b in zip(first.values(), second.values(), strict=True)
    )


def loss_names(losses):
    return {key for key, _ in losses.items() if key.startswith("loss_")}


OF_PRIOR_LOSS = {"method", "td_error", "bonus_coeff", "aux_coeff", "gamma", "num_samples", "prior_in_batch"}


def make_ppo_prior(
    actor, critic, prior, prior_weight=None, prior_critic=None, loss_class=ClipPPOPriorLoss, functional=True, **kwargs
):
    """PPO with one teacher; each setting goes to the loss that it is of."""
    options = {name: kwargs.pop(name) for name in OF_PRIOR_LOSS & kwargs.keys()}
    prior_critic = critic if options.get("td_error") == "shaped" else prior_critic
    prior_loss = AE2RLoss(actor, prior, prior_weight, prior_critic, functional=functional, **options)
    return loss_class(actor, critic, prior_loss, **kwargs)


def make_ae2r(method="ae2r", kind="categorical", **kwargs):
    options = {"prior_weight": make_weight(), "critic_network": make_critic(), **kwargs}
    return AE2RLoss(make_actor(kind), make_actor(kind), method=method, **options)


def make_networks(kind="categorical"):
    return {
        "actor": make_actor(kind),
        "critic": make_critic(),
        "prior": make_actor(kind),
        "prior_weight": make_weight(),
        "prior_critic": make_critic(),
    }


def make_ppo_loss(method="ae2r", kind="categorical", **kwargs):
    return make_ppo_prior(**{**make_networks(kind), "method": method, **kwargs})
