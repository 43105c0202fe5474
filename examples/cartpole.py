"""Discrete actions, and a student that outgrows its teacher: CartPole with a simple bot, in one loss module.

The bot pushes to the side the pole leans to, which balances it for some forty steps. What it says counts less and less,
by a schedule: with all of its weight to the end, kickstart ends as the bot does.

    python examples/cartpole.py
"""

import argparse

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives.value import GAE

from torchrl_priors import ActionPrior, AE2RLoss, ClipPPOPriorLoss, PriorWeight, prior_transforms
from torchrl_priors.collectors import make_vector_env
from torchrl_priors.methods import METHODS
from torchrl_priors.schedules import CoeffScheduler, LinearSchedule

parser = argparse.ArgumentParser()
parser.add_argument("--method", choices=METHODS, default="kickstart")
parser.add_argument("--frames", type=int, default=10_240)
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()
torch.manual_seed(args.seed)


def under_the_pole(observation):
    """The bot: logits of pushing left and right, by the angle alone."""
    right = observation[..., 2].sign()
    return torch.stack([-right, right], -1)


def categorical_actor(net):
    """A policy of the logits that ``net`` gives."""
    module = TensorDictModule(net, in_keys=["observation"], out_keys=["logits"])
    return ProbabilisticActor(
        module, in_keys=["logits"], distribution_class=torch.distributions.Categorical, return_log_prob=True
    )


def mlp(outputs):
    """A network of observations."""
    return MLP(in_features=4, out_features=outputs, num_cells=[64, 64])


def critic():
    """A critic."""
    return ValueOperator(mlp(1), in_keys=["observation"])


env = TransformedEnv(
    GymWrapper(make_vector_env("CartPole-v1", num_envs=16), categorical_action_encoding=True), RewardSum()
)
env.set_seed(args.seed)
actor, prior, weight = categorical_actor(mlp(2)), ActionPrior(categorical_actor(under_the_pole)), PriorWeight(mlp(1))
loss_prior = AE2RLoss(actor, prior, weight, critic(), method=args.method, bonus_coeff=0.1)
loss = ClipPPOPriorLoss(actor, critic(), loss_prior, normalize_advantage=True)
postproc = prior_transforms(loss)  # of the loss's networks and settings
advantage = GAE(gamma=0.99, lmbda=0.95, value_network=loss.critic_network)
advantage.set_keys(reward=loss.tensor_keys.reward)
slow = list(weight.parameters())
fast = [parameter for parameter in loss.parameters() if all(parameter is not other for other in slow)]
optim = torch.optim.Adam([{"params": fast, "lr": 1e-3}, {"params": slow, "lr": 1e-4}])
anneal = CoeffScheduler(loss, "prior_loss.aux_coeff", LinearSchedule(1.0, 0.0, frames=10_000))
collector = Collector(env, actor, frames_per_batch=2048, total_frames=args.frames, postproc=postproc)

for i, data in enumerate(collector):
    data = advantage(data).reshape(-1)
    for _ in range(5):
        for index in torch.randperm(len(data)).split(256):
            losses = loss(data[index])
            optim.zero_grad()
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            optim.step()
    anneal.step((i + 1) * len(data))
    returns = data["next", "episode_reward"][data["next", "done"]]
    print(f"{(i + 1) * len(data):6d} frames, return {returns.mean():5.0f}", flush=True)
collector.shutdown()
