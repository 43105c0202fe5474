"""Teachers of unknown worth: a student alone and one with each of three bots, and what their returns say of the bots.

The good bot balances the pole, the weak one for some forty steps, the bad one pushes it over. Frames of all students
count. The winner goes on, and its teacher is let go when returns do not rise any more.

    python examples/trial.py
"""

import argparse

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives.value import GAE

from torchrl_priors import ActionPrior, AE2RLoss, ClipPPOPriorLoss, Plateau, TeacherTrial, prior_transforms
from torchrl_priors.collectors import make_vector_env

parser = argparse.ArgumentParser()
parser.add_argument("--method", choices=["kickstart", "pull"], default="kickstart")
parser.add_argument("--frames", type=int, default=40_960)
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()

BOTS = {  # what pushes to the right, by position, velocity, angle and angular velocity
    "alone": None,
    "good bot": torch.tensor([0.1, 0.5, 4.0, 4.0]),
    "weak bot": torch.tensor([0.0, 0.0, 9.0, 0.0]),
    "bad bot": torch.tensor([0.0, 0.0, -9.0, 0.0]),
}


def categorical_actor(net):
    """A policy of the logits that ``net`` gives."""
    module = TensorDictModule(net, in_keys=["observation"], out_keys=["logits"])
    return ProbabilisticActor(
        module, in_keys=["logits"], distribution_class=torch.distributions.Categorical, return_log_prob=True
    )


def bot(push):
    """A teacher: the more its sum says right, the more probable is right."""

    def logits(observation):
        right = observation @ push
        return torch.stack([-right, right], -1)

    return ActionPrior(categorical_actor(logits))


class Student:
    """PPO in its own environments, with the advice of a bot or without."""

    def __init__(self, push):
        torch.manual_seed(args.seed)
        env = GymWrapper(make_vector_env("CartPole-v1", num_envs=16), categorical_action_encoding=True)
        env = TransformedEnv(env, RewardSum())
        env.set_seed(args.seed)
        actor = categorical_actor(MLP(in_features=4, out_features=2, num_cells=[64, 64]))
        critic = ValueOperator(MLP(in_features=4, out_features=1, num_cells=[64, 64]), in_keys=["observation"])
        method, prior = ("none", bot(torch.zeros(4))) if push is None else (args.method, bot(push))
        self.loss = ClipPPOPriorLoss(actor, critic, AE2RLoss(actor, prior, method=method), normalize_advantage=True)
        self.advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
        self.optim = torch.optim.Adam(self.loss.parameters(), lr=1e-3)
        postproc = prior_transforms(self.loss)
        self.batches = iter(Collector(env, actor, frames_per_batch=2048, total_frames=-1, postproc=postproc))

    def round(self):
        """Collect a batch and train on it; the batch."""
        batch = next(self.batches)
        data = self.advantage(batch.clone()).reshape(-1)
        for index in (index for _ in range(5) for index in torch.randperm(len(data)).split(256)):
            losses = self.loss(data[index])
            self.optim.zero_grad()
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            self.optim.step()
        return batch


students = {name: Student(push) for name, push in BOTS.items()}
trial = TeacherTrial(students, max_frames=args.frames // 5)  # of each
while trial.decide() is None:
    for name in trial.active:
        trial.update(name, students[name].round())
print(trial.result)

winner, frames = students[trial.result.winner], sum(trial.frames.values())
plateau = Plateau(window=4096)
while frames < args.frames:
    batch = winner.round()
    frames += batch.numel()
    plateau.update(batch)
    if plateau.reached:
        winner.loss.prior_loss.aux_coeff.zero_()
    returns, coeff = batch["next", "episode_reward"][batch["next", "done"]], winner.loss.prior_loss.aux_coeff
    print(f"{frames:6d} frames, return {returns.mean():5.0f}, teacher's coefficient {coeff:.0f}", flush=True)
