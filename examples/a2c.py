"""AE2R added to A2C. The student's observations are normalised, the teacher's are not.

In MountainCar every step costs 1 until the top is reached, so that A2C alone meets no reward to learn from. The bot
pushes the way the car already rolls. It reads the raw ``observation``, the student ``observation_norm``: a teacher
must never be fed with another's normaliser.

    python examples/a2c.py
     51200 frames, return -132.1     (seed 0, the last line; 9 s of one core)
    python examples/a2c.py --method none
     51200 frames, return -200.0
"""

import argparse

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, GymWrapper, ObservationNorm, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import A2CLoss
from torchrl.objectives.value import GAE

from torchrl_priors import ActionPrior, AE2RLoss, PriorBonus, PriorLogProb, PriorWeight
from torchrl_priors.collectors import make_vector_env
from torchrl_priors.methods import METHODS

parser = argparse.ArgumentParser()
parser.add_argument("--method", choices=METHODS, default="ae2r")
parser.add_argument("--frames", type=int, default=51_200)
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()
torch.manual_seed(args.seed)


def along_the_roll(observation):
    """The bot: logits of pushing left, not at all, right."""
    right = 2 * observation[..., 1].sign()
    return torch.stack([-right, torch.full_like(right, -2.0), right], -1)


def categorical_actor(net, key):
    """A policy of the logits that ``net`` gives."""
    module = TensorDictModule(net, in_keys=[key], out_keys=["logits"])
    return ProbabilisticActor(
        module, in_keys=["logits"], distribution_class=torch.distributions.Categorical, return_log_prob=True
    )


def mlp(outputs):
    """A network of normalised observations."""
    return MLP(in_features=2, out_features=outputs, num_cells=[64])


env = TransformedEnv(
    GymWrapper(make_vector_env("MountainCar-v0", num_envs=32), categorical_action_encoding=True),
    Compose(
        RewardSum(),
        ObservationNorm(
            torch.tensor([0.5, 0.0]),
            torch.tensor([2.0, 30.0]),
            in_keys=["observation"],
            out_keys=["observation_norm"],
        ),
    ),
)
env.set_seed(args.seed)
actor = categorical_actor(mlp(3), "observation_norm")
critic, raw_critic = (ValueOperator(mlp(1), in_keys=["observation_norm"]) for _ in range(2))
prior = ActionPrior(categorical_actor(along_the_roll, "observation"))
weight = PriorWeight(mlp(1), in_keys=["observation_norm"])

log_prob = PriorLogProb(prior, actor)
bonus = PriorBonus.from_method(args.method, weight, bonus_coeff=0.1)
loss = A2CLoss(actor, critic, entropy_coeff=0.01)
loss_prior = AE2RLoss(actor, prior, weight, raw_critic, method=args.method, bonus_coeff=0.1)
advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
advantage.set_keys(reward="shaped_reward")
networks = nn.ModuleList([actor, critic, raw_critic])
optim = torch.optim.Adam([{"params": networks.parameters(), "lr": 3e-3}, {"params": weight.parameters(), "lr": 1e-4}])
collector = Collector(env, actor, frames_per_batch=512, total_frames=args.frames, postproc=log_prob)

returns = []
for i, data in enumerate(collector):
    data = advantage(bonus(data))
    losses = {**loss(data), **loss_prior(data)}
    optim.zero_grad()
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    optim.step()
    returns += data["next", "episode_reward"][data["next", "done"]].tolist()
    if (i + 1) % 20 == 0 or (i + 1) * data.numel() >= args.frames:
        mean = sum(returns) / len(returns) if returns else float("nan")
        print(f"{(i + 1) * data.numel():6d} frames, return {mean:6.1f}", flush=True)
        returns = []
collector.shutdown()
