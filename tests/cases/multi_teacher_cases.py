"""Teachers that tests of several share."""

from __future__ import annotations

import torch
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives.value import GAE

from torchrl_priors import ClipPPOPriorLoss, MultiTeacherLoss, Prior, PriorWeight, prior_transforms


def train(
    env: EnvBase, actor: ProbabilisticActor, priors: list[Prior], *, method: str = "ae2r", batches: int = 8
) -> list[PriorWeight]:
    """PPO with an AE2R loss for each teacher; the weights of the teachers."""
    critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    raw_critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    weights = [PriorWeight(nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 1))) for _ in priors]
    loss_prior = MultiTeacherLoss(
        actor, priors, weights, raw_critic, method=method, gamma=0.9, prior_in_batch=True, num_samples=4
    )
    loss = ClipPPOPriorLoss(actor, critic, loss_prior)
    gae = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
    gae.set_keys(reward=loss.tensor_keys.reward)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.03)
    env.set_seed(0)
    collector = Collector(
        env, actor, frames_per_batch=128, total_frames=batches * 128, postproc=prior_transforms(loss, num_samples=1)
    )
    for batch in collector:
        flat = gae(batch).reshape(-1)
        for _ in range(4):
            for index in torch.randperm(128).split(64):
                losses = loss(flat[index])
                objective = sum(value for key, value in losses.items() if key.startswith("loss_"))
                assert objective.isfinite()
                optimizer.zero_grad()
                objective.backward()
                optimizer.step()
    return weights


RIGHT = torch.tensor([[-4.0, 0.0, 0.0], [4.0, 0.0, 0.0]])


def linear(weights: torch.Tensor) -> nn.Linear:
    net = nn.Linear(weights.shape[1], weights.shape[0], bias=False)
    net.weight.data.copy_(weights)
    return net
