"""The batched study and the TensorDict modules are one method: the same episode gives the same update."""

from __future__ import annotations

from functools import cache

import pytest
import torch
from tabular_cases import Step, Study, Tables, play, read_tables
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ReinforceLoss
from torchrl.objectives.value import TD0Estimator

from torchrl_priors.degradation import RandomDegradation, StructuralDegradation
from torchrl_priors.lookup import StateTable
from torchrl_priors.methods import METHODS, get_method
from torchrl_priors.objectives import AE2RLoss
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import BoltzmannPrior
from torchrl_priors.schedules import CoeffScheduler, CosineSchedule
from torchrl_priors.tabular import StudentConfig, runs_of
from torchrl_priors.transforms import PriorBonus, PriorLogProb

PRIORS = ["expert", "random_30", "structural_3"]
STEPS = 60


@cache
def recorded(td_error: str) -> tuple[Study, Tensor, list[Step], int]:
    """Every method with every prior, from random tables on."""
    study = Study.small(runs_of(list(METHODS), PRIORS), td_error=td_error)
    first, history, _, runs = play(study, STEPS, random_tables=True)
    return study, first, history, len(runs.key)


def episodes_of(history: list[Step], row: int) -> list[list[Step]]:
    """The steps of a row, an episode each; what does not end is left out."""
    episodes: list[list[Step]] = [[]]
    for step in history:
        episodes[-1].append(step)
        if step.done[row]:
            episodes.append([])
    return episodes[:-1]


def as_batch(steps: list[Step], row: int) -> TensorDict:
    """An episode as a rollout would give it, and whose advice each step saw."""
    fields = {name: torch.stack([getattr(step, name)[row] for step in steps]) for name in Step._fields[:7]}
    done = fields["done"].unsqueeze(-1)
    return TensorDict(
        {
            "state": fields["state"],
            "action": fields["action"],
            "steps": fields["steps"],
            "prior": {"degraded": fields["degraded"].unsqueeze(-1)},
            "next": {
                "state": fields["next_state"],
                "reward": fields["reward"].unsqueeze(-1),
                "done": done,
                "terminated": done.clone(),
            },
        },
        [len(steps)],
        names=["time"],
    )


class Student:
    """The tabular student of one run, out of the library's modules and TorchRL's."""

    def __init__(self, study: Study, method: str, prior: str, world: int, tables: Tables) -> None:
        config, self.spec = study.config, get_method(method)
        self.logits, self.value, self.raw_value = (
            nn.Parameter(table.clone()) for table in (tables.logits, *(v.unsqueeze(-1) for v in tables[1:3]))
        )
        self.weight = PriorWeight.table(study.states)
        self.weight_logits = self.weight.logit.table
        self.weight_logits.data.copy_(tables.weight.unsqueeze(-1))

        teacher = BoltzmannPrior(study.q[world], config.temperature)
        if prior.startswith("structural"):
            teacher = StructuralDegradation(teacher, study.degraded[3][world])
        elif prior.startswith("random"):
            teacher = RandomDegradation(teacher, 0.3)

        actor = ProbabilisticActor(
            StateTable(self.logits, in_key="state", out_key="logits", feature_dims=1),
            in_keys=["logits"],
            distribution_class=torch.distributions.Categorical,
        )
        critic, raw_critic = (
            StateTable(table, in_key="state", out_key="state_value", feature_dims=1)
            for table in (self.value, self.raw_value)
        )
        self.log_prob = PriorLogProb(teacher, boundary="zero")
        self.bonus = PriorBonus.from_method(method, self.weight, bonus_coeff=config.bonus_coeff)
        self.td_error = TD0Estimator(gamma=config.hyper.gamma, value_network=critic)
        self.td_error.set_keys(reward="shaped_reward")
        self.policy_loss = ReinforceLoss(actor, critic, loss_critic_type="l2", reduction="sum")
        self.prior_loss = AE2RLoss(
            actor,
            teacher,
            self.weight,
            raw_critic if config.td_error == "original" else critic,
            method=method,
            td_error=config.td_error,
            bonus_coeff=config.bonus_coeff,
            aux_coeff=config.aux_coeff,
            gamma=config.hyper.gamma,
            reduction="sum",
        )
        self.actor, self.schedule = actor, None
        if self.spec.annealed:
            self.schedule = CoeffScheduler(self.prior_loss, "aux_coeff", self.annealing(config))
        # The gradient of a squared error is twice that of a TD(0) step.
        self.critics = torch.optim.SGD([self.value, self.raw_value], lr=config.hyper.lr / 2)
        self.actor_and_weight = torch.optim.SGD(
            [
                {"params": [self.logits], "lr": config.hyper.lr},
                {"params": [self.weight_logits], "lr": config.lr_weight[self.spec.weight_target]},
            ]
        )

    @staticmethod
    def annealing(config: StudentConfig) -> CosineSchedule:
        schedule = config.hyper.schedule
        assert isinstance(schedule, CosineSchedule)
        return CosineSchedule(config.aux_coeff * schedule.start, config.aux_coeff * schedule.end, schedule.frames)

    def learn(self, episode: TensorDict) -> None:
        """One whole episode: critics online, actor and prior weight at its end."""
        self.actor_and_weight.zero_grad()
        with torch.no_grad():  # the policy is the same during an episode
            episode["action_log_prob"] = self.actor.get_dist(episode.copy()).log_prob(episode["action"])
        for step in self.bonus(self.log_prob(episode)).split(1):
            self.critics.zero_grad()
            if self.schedule is not None:
                self.schedule.step(int(step["steps"]))
            with torch.no_grad():
                self.td_error(step)
            policy, prior = self.policy_loss(step), self.prior_loss(step)
            losses = [policy["loss_actor"], policy["loss_value"]]
            losses += [prior[name] for name in ("loss_prior", "loss_prior_critic") if name in prior]
            by_advantage = self.spec.weight_target == "advantage"
            if by_advantage:  # the advantage is that of the critic before its update, as the actor's
                losses.append(prior["loss_prior_weight"])
            sum(losses).backward()
            self.critics.step()
            if self.spec.adaptive and not by_advantage:  # the prior weight is updated after the critic
                self.prior_loss(step)["loss_prior_weight"].backward()
        self.actor_and_weight.step()

    def tables(self) -> Tables:
        return Tables(
            self.logits.detach().clone(),
            *(table.detach().squeeze(-1).clone() for table in (self.value, self.raw_value, self.weight_logits)),
        )


@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("method", [method for method in METHODS if method != "none"])
def test_batched_study_and_modules_give_the_same_update(method, prior, td_error):
    study, first, history, rows = recorded(td_error)
    row = study.row((method, prior))
    spec = get_method(method)
    student = Student(study, method, prior, 0, Tables(*(table[row] for table in read_tables(first, rows))))
    episodes = episodes_of(history, row)
    assert max(map(len, episodes)) > 2
    before = student.tables()
    for steps in episodes:
        student.learn(as_batch(steps, row))
        batched = Tables(*(table[row] for table in read_tables(steps[-1].records, rows)))
        theirs = student.tables()
        torch.testing.assert_close(theirs.logits, batched.logits, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(theirs.value, batched.value, rtol=1e-4, atol=1e-5)
        if spec.adaptive:
            torch.testing.assert_close(theirs.weight, batched.weight, rtol=1e-4, atol=1e-5)
            if td_error == "original":
                torch.testing.assert_close(theirs.raw_value, batched.raw_value, rtol=1e-4, atol=1e-5)
    # The comparison saw something: every table that the method learns has moved.
    assert (student.logits - before.logits).abs().max() > 0.1
    assert (student.value.squeeze(-1) - before.value).abs().max() > 0.1
    assert ((student.weight_logits.squeeze(-1) - before.weight).abs().max() > 1e-3) == spec.adaptive
