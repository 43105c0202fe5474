"""The compiled study and the TensorDict modules are one method: the same episode gives the same update."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tabular_cases import COEFFS, PRIORS, RATES, STATES, PlainStudent, Run, Visit, make_run, random_tables
from tensordict import TensorDict
from torch import nn
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ReinforceLoss
from torchrl.objectives.value import TD0Estimator

from recipes.gridworld import run_parts, tabular
from torchrl_priors.degradation import RandomDegradation, StructuralDegradation
from torchrl_priors.methods import METHODS, get_method
from torchrl_priors.objectives import AE2RLoss
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import BoltzmannPrior
from torchrl_priors.schedules import CoeffScheduler, CosineSchedule
from torchrl_priors.state_table import StateTable
from torchrl_priors.transforms import PriorBonus, PriorLogProb


def as_batch(visits: list[Visit]) -> TensorDict:
    """An episode as a rollout would give it, and whose advice each step saw."""
    columns = (torch.tensor(column) for column in zip(*visits, strict=True))
    state, action, reward, done, next_state, adverse, steps = columns
    done = done.unsqueeze(-1)
    return TensorDict(
        {
            "state": state,
            "action": action,
            "steps": steps,
            "prior": {"degraded": adverse.unsqueeze(-1)},
            "next": {
                "state": next_state,
                "reward": reward.float().unsqueeze(-1),
                "done": done,
                "terminated": done.clone(),
            },
        },
        [len(visits)],
        names=["time"],
    )


class Student:
    """The tabular student of one run, out of the library's modules and TorchRL's."""

    def __init__(self, run: Run, tables: run_parts.Tables) -> None:
        method, prior, td_error, self.spec = run.method, run.prior, run.td_error, get_method(run.method)
        coeffs = {name: COEFFS[name] for name in ("bonus_coeff", "aux_coeff", "gamma")}
        self.logits, self.value, self.raw_value = (
            nn.Parameter(torch.from_numpy(table).float())
            for table in (tables.logits, tables.value[:, None], tables.raw_value[:, None])
        )
        self.weight = PriorWeight.table(STATES)
        self.weight_logits = self.weight.logit.table
        self.weight_logits.data.copy_(torch.from_numpy(tables.weight_logit[:, None]))

        teacher = BoltzmannPrior(torch.from_numpy(run.q).float(), 1.5)
        if prior.startswith("structural"):
            teacher = StructuralDegradation(teacher, torch.from_numpy(run.advice.degraded))
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
        self.bonus = PriorBonus.from_method(method, self.weight, bonus_coeff=COEFFS["bonus_coeff"])
        self.td_error = TD0Estimator(gamma=COEFFS["gamma"], value_network=critic)
        self.td_error.set_keys(reward="shaped_reward")
        self.policy_loss = ReinforceLoss(actor, critic, loss_critic_type="l2", reduction="sum")
        self.prior_loss = AE2RLoss(
            actor,
            teacher,
            self.weight,
            raw_critic if td_error == "original" else critic,
            method=method,
            td_error=td_error,
            reduction="sum",
            **coeffs,
        )
        self.actor, self.schedule = actor, None
        if self.spec.annealed:
            self.schedule = CoeffScheduler(
                self.prior_loss, "aux_coeff", CosineSchedule(COEFFS["aux_coeff"], 0.2 * COEFFS["aux_coeff"], frames=40)
            )
        # The gradient of a squared error is twice that of a TD(0) step.
        self.critics = torch.optim.SGD([self.value, self.raw_value], lr=COEFFS["lr"] / 2)
        self.actor_and_weight = torch.optim.SGD(
            [
                {"params": [self.logits], "lr": COEFFS["lr"]},
                {"params": [self.weight_logits], "lr": RATES[self.spec.weight_target]},
            ]
        )

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

    def tables(self) -> dict[str, np.ndarray]:
        tables = {"logits": self.logits, "value": self.value, "raw_value": self.raw_value}
        tables["weight_logit"] = self.weight_logits
        return {name: table.detach().squeeze(-1).double().numpy().copy() for name, table in tables.items()}


@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("method", [method for method in METHODS if method != "none"])
def test_compiled_study_and_modules_give_the_same_update(method, prior, td_error):
    run, spec = make_run(method, prior, 0, td_error), get_method(method)
    tables = random_tables(run)
    student, witness, lengths, steps = Student(run, tables), PlainStudent(run, tables), [], 0
    before, rng, same = (
        student.tables(),
        run_parts.generator(5, method, prior),
        run_parts.generator(5, method, prior),
    )
    for _ in range(6):
        visits = witness.train_episode(same)  # says what the loop does next
        steps = tabular.train_episode(run.world, run.advice, run.learner, tables, steps, rng)
        assert steps == witness.steps
        student.learn(as_batch(visits))
        theirs = student.tables()
        learned = ["logits", "value"] + ["weight_logit"] * spec.adaptive
        learned += ["raw_value"] * (spec.adaptive and td_error == "original")
        for name in learned:
            np.testing.assert_allclose(theirs[name], getattr(tables, name), rtol=1e-4, atol=2e-5, err_msg=name)
        lengths.append(len(visits))
    # The comparison saw something: every table that the method learns has moved.
    assert max(lengths) > 2
    moved = {name: np.abs(theirs[name] - before[name]).max() for name in theirs}
    assert moved["logits"] > 0.1
    assert moved["value"] > 0.1
    assert (moved["weight_logit"] > 1e-3) == spec.adaptive
