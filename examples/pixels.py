"""Nested keys everywhere, and a teacher that sees more than its student: the game of ``catch.py``.

The student sees pixels, the bot is told the columns of ball and paddle. ``set_keys`` says where everything is.

    python examples/pixels.py
"""

import argparse

import torch
from catch import Catch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.modules import MLP, ConvNet, ProbabilisticActor, ValueOperator
from torchrl.objectives.value import GAE

from torchrl_priors import ActionPrior, AE2RLoss, ClipPPOPriorLoss, PriorWeight, prior_transforms
from torchrl_priors.methods import METHODS

parser = argparse.ArgumentParser()
parser.add_argument("--method", choices=METHODS, default="ae2r")
parser.add_argument("--frames", type=int, default=15_360)
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()
torch.manual_seed(args.seed)

PIXELS, COLUMNS = ("agent", "observation", "pixels"), ("agent", "observation", "columns")


def follow(columns):
    """The bot: logits of moving left, staying, moving right, towards the column of the ball."""
    ball, paddle = columns.unbind(-1)
    wanted = (ball - paddle).sign().long() + 1
    return 3.0 * nn.functional.one_hot(wanted, 3)


def categorical_actor(net, key):
    """A policy of the logits that ``net`` gives, all of whose entries are the agent's."""
    module = TensorDictModule(net, in_keys=[key], out_keys=[("agent", "logits")])
    return ProbabilisticActor(
        module,
        in_keys={"logits": ("agent", "logits")},
        out_keys=[("agent", "action")],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
        log_prob_key=("agent", "log_prob"),
    )


def cnn(outputs):
    """From images ``[*B, 1, 7, 7]`` to ``[*B, outputs]``."""
    conv = ConvNet(in_features=1, num_cells=[8], kernel_sizes=3)
    return nn.Sequential(conv, MLP(in_features=200, out_features=outputs, num_cells=[64]))


def critic(value_key):
    """A critic."""
    return ValueOperator(cnn(1), in_keys=[PIXELS], out_keys=[value_key])


env = Catch(games=32)
env.set_seed(args.seed)
actor = categorical_actor(cnn(3), PIXELS)
prior = ActionPrior(categorical_actor(follow, COLUMNS), namespace=("agent", "prior"))
prior.set_keys(action=("agent", "action"))
weight = PriorWeight(cnn(1), in_keys=[PIXELS], out_keys=[("agent", "prior_weight")])
value, raw_value = critic(("agent", "value")), critic(("agent", "raw_value"))
loss_prior = AE2RLoss(actor, prior, weight, raw_value, method=args.method, bonus_coeff=0.1)
loss_prior.set_keys(**{name: ("agent", name) for name in ("reward", "terminated", "prior_log_prob", "prior_bonus")})
loss = ClipPPOPriorLoss(actor, value, loss_prior)
keys = {name: ("agent", name) for name in ("action", "done", "terminated", "value", "advantage", "value_target")}
keys |= {"reward": ("agent", "shaped_reward"), "sample_log_prob": ("agent", "log_prob")}
loss.set_keys(**keys)
advantage = GAE(gamma=0.99, lmbda=0.95, value_network=loss.critic_network, average_gae=True)
advantage.set_keys(
    **{name: keys[name] for name in ("reward", "done", "terminated", "value", "advantage", "value_target")}
)
postproc = prior_transforms(loss)
optim = torch.optim.Adam(loss.parameters(), lr=1e-3)
collector = Collector(env, actor, frames_per_batch=1536, total_frames=args.frames, postproc=postproc)

for i, data in enumerate(collector):
    data = advantage(data).reshape(-1)
    for _ in range(4):
        for index in torch.randperm(len(data)).split(256):
            losses = loss(data[index])
            optim.zero_grad()
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            optim.step()
    caught = data["next", "agent", "reward"][data["next", "agent", "done"]] > 0
    print(f"{(i + 1) * len(data):6d} frames, caught {caught.float().mean():.0%}", flush=True)
collector.shutdown()
