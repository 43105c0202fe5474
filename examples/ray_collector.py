"""Several machines: ``RayCollector`` with the transforms as its ``postproc``, on CartPole. Needs the extra ``sweeps``.

The networks and the environment are those of ``multi_sync.py``. Workers are actors of Ray, which only act. They live
on this machine, or with ``--address`` on those of a cluster (``auto``, or ``host:port``) that see this folder. The
transforms run here, on the batch of all workers, with the student as it is here.

    python examples/ray_collector.py
"""

import argparse

import ray
import torch
from multi_sync import balance, categorical_actor, critic, make_env, mlp
from torchrl.collectors.distributed import RayCollector
from torchrl.objectives.value import GAE

from torchrl_priors import ActionPrior, AE2RLoss, ClipPPOPriorLoss, PriorWeight, prior_transforms
from torchrl_priors.methods import METHODS

parser = argparse.ArgumentParser()
parser.add_argument("--method", choices=METHODS, default="ae2r")
parser.add_argument("--frames", type=int, default=30_720)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--workers", type=int, default=2)
parser.add_argument("--address", default="local")
args = parser.parse_args()
torch.manual_seed(args.seed)

actor, prior, weight = categorical_actor(mlp(2)), ActionPrior(categorical_actor(balance)), PriorWeight(mlp(1))
loss_prior = AE2RLoss(actor, prior, weight, critic(), method=args.method, bonus_coeff=0.1)
loss = ClipPPOPriorLoss(actor, critic(), loss_prior)
advantage = GAE(gamma=0.99, lmbda=0.95, value_network=loss.critic_network, average_gae=True)
advantage.set_keys(reward=loss.tensor_keys.reward)
optim = torch.optim.Adam(loss.parameters(), lr=1e-3)
collector = RayCollector(
    [make_env] * args.workers,
    actor,
    frames_per_batch=2048,
    total_frames=args.frames,
    sync=True,
    update_after_each_batch=True,  # the workers get the student's weights
    postproc=prior_transforms(loss),
    ray_init_config={"address": args.address, "include_dashboard": False, "log_to_driver": False},
    remote_configs={"num_cpus": 1},
)
collector.set_seed(args.seed)

frames = 0
for data in collector:  # [workers, environments, time]
    data = advantage(data).reshape(-1)
    for _ in range(5):
        for index in torch.randperm(len(data)).split(256):
            losses = loss(data[index])
            optim.zero_grad()
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            optim.step()
    frames += len(data)
    returns = data["next", "episode_reward"][data["next", "done"]]
    print(f"{frames:6d} frames, return {returns.mean():5.0f}", flush=True)
ray.shutdown()
