"""AE2R added to TorchRL's own PPO recipe. The teacher is a bot that swings a pendulum up.

What is added to the recipe: a prior, its weight, two transforms and a second loss. The lines say so.

    python examples/ppo.py
    38400 frames, return   -190, prior weight 0.35     (seed 0, the last line; 22 s of one core)
"""

import argparse

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import Compose, GymWrapper, RewardScaling, RewardSum, TransformedEnv
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_priors import ActionPrior, AE2RLoss, PriorBonus, PriorLogProb, PriorWeight
from torchrl_priors.collectors import make_vector_env
from torchrl_priors.methods import METHODS

parser = argparse.ArgumentParser()
parser.add_argument("--method", choices=METHODS, default="ae2r")
parser.add_argument("--frames", type=int, default=38_400)
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()
torch.manual_seed(args.seed)


def swing_up(observation):
    """The bot: pump energy while the pendulum hangs, hold it when it is up. Mean and spread of its torque."""
    cos, sin, speed = observation.unbind(-1)
    energy = 0.5 * speed**2 + 15 * (cos - 1)
    torque = torch.where(cos > 0.9, -8 * sin - 2 * speed, -0.05 * speed * energy)
    loc = torque.clamp(-2, 2).unsqueeze(-1)
    return loc, torch.ones_like(loc)


def gaussian_actor(net):
    """A policy of the mean and the spread that ``net`` gives."""
    module = TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True
    )


def mlp():
    """From an observation to a number."""
    return MLP(in_features=3, out_features=1, num_cells=[64, 64])


env = TransformedEnv(
    GymWrapper(make_vector_env("Pendulum-v1", num_envs=16)),
    Compose(RewardSum(), RewardScaling(0.0, 0.1)),  # episode_reward is the sum of the unscaled rewards
)
env.set_seed(args.seed)
actor = gaussian_actor(nn.Sequential(mlp(), AddStateIndependentNormalScale(1)))
critic = ValueOperator(mlp(), in_keys=["observation"])

prior, weight = ActionPrior(gaussian_actor(swing_up)), PriorWeight(mlp())  # added
raw_critic = ValueOperator(mlp(), in_keys=["observation"])  # added: it never sees the bonus
bonus_coeff = 0.1  # rewards are scaled by 0.1, so is the bonus
log_prob = PriorLogProb(prior, actor)  # added
bonus = PriorBonus.from_method(args.method, weight, bonus_coeff=bonus_coeff)  # added
loss_prior = AE2RLoss(  # added
    actor, prior, weight, raw_critic, method=args.method, gamma=0.95, bonus_coeff=bonus_coeff
)

loss = ClipPPOLoss(actor, critic, normalize_advantage=True, entropy_coeff=0.0)
advantage = GAE(gamma=0.95, lmbda=0.95, value_network=critic)
advantage.set_keys(reward="shaped_reward")  # added
networks = nn.ModuleList([actor, critic, raw_critic])
optim = torch.optim.Adam(
    [
        {"params": networks.parameters(), "lr": 1e-3},
        {"params": weight.parameters(), "lr": 3e-5},  # added: slower, so that advice is not judged too early
    ]
)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(3200), sampler=SamplerWithoutReplacement(), batch_size=320)
collector = Collector(env, actor, frames_per_batch=3200, total_frames=args.frames, postproc=log_prob)  # added: postproc

for i, data in enumerate(collector):
    data = bonus(data)  # added
    with torch.no_grad():
        buffer.extend(advantage(data).reshape(-1))
    for _ in range(10):
        for batch in buffer:
            losses = {**loss(batch), **loss_prior(batch)}  # added: the second loss
            optim.zero_grad()
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            optim.step()
    returns = data["next", "episode_reward"][data["next", "done"]]
    omega = losses["prior_weight"].item() if "prior_weight" in losses else float("nan")
    print(f"{(i + 1) * data.numel():6d} frames, return {returns.mean():6.0f}, prior weight {omega:.2f}", flush=True)
collector.shutdown()
