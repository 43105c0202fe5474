"""AE2R through TorchRL's ``PPOTrainer``: one loss and one hook, on CartPole.

The hook shapes the reward of every batch with the networks and settings of the loss.

    python examples/trainer.py
"""

import argparse

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import GymWrapper, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.trainers.algorithms import PPOTrainer

from torchrl_priors import ActionPrior, AE2RLoss, ClipPPOPriorLoss, PriorShaping, PriorWeight
from torchrl_priors.collectors import make_vector_env
from torchrl_priors.methods import METHODS

parser = argparse.ArgumentParser()
parser.add_argument("--method", choices=METHODS, default="ae2r")
parser.add_argument("--frames", type=int, default=30_720)
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()
torch.manual_seed(args.seed)


def balance(observation):
    """The bot: logits of pushing left and right, by the angle and its speed."""
    right = 2 * (observation[..., 2] + 0.3 * observation[..., 3]).sign()
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
actor = categorical_actor(mlp(2))
prior, weight = ActionPrior(categorical_actor(balance)), PriorWeight(mlp(1))
loss_prior = AE2RLoss(actor, prior, weight, critic(), method=args.method, bonus_coeff=0.1)
loss = ClipPPOPriorLoss(actor, critic(), loss_prior)
trainer = PPOTrainer(
    collector=Collector(env, actor, frames_per_batch=2048, total_frames=args.frames),
    total_frames=args.frames,
    frame_skip=1,
    loss_module=loss,
    optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
    replay_buffer=TensorDictReplayBuffer(
        storage=LazyTensorStorage(2048), sampler=SamplerWithoutReplacement(), batch_size=256
    ),
    optim_steps_per_batch=8,
    num_epochs=5,
    reward_key=loss.tensor_keys.reward,  # the shaped reward, where the method has a bonus
    progress_bar=False,
    enable_logging=False,
)
PriorShaping().register(trainer)


def report(batch):
    """Prints the mean return of the episodes that ended in a batch."""
    returns = batch["next", "episode_reward"][batch["next", "done"]]
    print(f"{trainer.collected_frames:6d} frames, return {returns.mean():5.0f}", flush=True)


trainer.register_op("pre_steps_log", report)
trainer.train()
