"""Several processes: ``MultiSyncCollector`` with the transforms as its ``postproc``, on CartPole.

Workers only act. The transform runs in the main process, on the batch of all workers, with the student as it is there.

    python examples/multi_sync.py
"""

import argparse

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import GymWrapper, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives.value import GAE

from torchrl_priors import ActionPrior, AE2RLoss, ClipPPOPriorLoss, PriorWeight, prior_transforms
from torchrl_priors.collectors import make_vector_env
from torchrl_priors.methods import METHODS


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


def make_env():
    """The environment of a worker: eight in one."""
    return TransformedEnv(
        GymWrapper(make_vector_env("CartPole-v1", num_envs=8), categorical_action_encoding=True), RewardSum()
    )


if __name__ == "__main__":  # workers import this file
    parser = argparse.ArgumentParser()
    parser.add_argument("--method", choices=METHODS, default="ae2r")
    parser.add_argument("--frames", type=int, default=30_720)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.manual_seed(args.seed)

    actor, prior, weight = categorical_actor(mlp(2)), ActionPrior(categorical_actor(balance)), PriorWeight(mlp(1))
    loss_prior = AE2RLoss(actor, prior, weight, critic(), method=args.method, bonus_coeff=0.1)
    loss = ClipPPOPriorLoss(actor, critic(), loss_prior)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=loss.critic_network, average_gae=True)
    advantage.set_keys(reward=loss.tensor_keys.reward)
    optim = torch.optim.Adam(loss.parameters(), lr=1e-3)
    collector = MultiSyncCollector(
        [make_env, make_env],
        actor,
        frames_per_batch=2048,
        total_frames=args.frames,
        postproc=prior_transforms(loss),
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
        collector.update_policy_weights_()
        frames += len(data)
        returns = data["next", "episode_reward"][data["next", "done"]]
        print(f"{frames:6d} frames, return {returns.mean():5.0f}", flush=True)
    collector.shutdown()
