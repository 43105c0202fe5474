"""A teacher with a memory is refused by name, however it keeps it; what it wrote into a batch can advise."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule, TensorDictSequential
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import GRUModule, LSTMModule, ProbabilisticActor

from torchrl_priors import ActionPrior, AE2RLoss, BoltzmannPrior, ModulePrior, PriorLogProb
from torchrl_priors.priors.memory import without_memory


class Replaces(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.cell = nn.GRUCell(3, 2)
        self.register_buffer("hidden", torch.zeros(1, 2))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        new = self.cell(observation, self.hidden.expand(observation.shape[0], 2))
        self.hidden = new.mean(0, keepdim=True)
        return new


class Overwrites(Replaces):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        new = self.cell(observation, self.hidden.expand(observation.shape[0], 2))
        self.hidden[:] = new.mean(0, keepdim=True)
        return new


class Assigns(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.cell = nn.GRUCell(3, 2)
        self.hidden = torch.zeros(1, 2)  # no buffer

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        new = self.cell(observation, self.hidden.expand(observation.shape[0], 2))
        self.hidden = new.mean(0, keepdim=True)
        return new


class Counts(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Linear(3, 2)
        self.steps = 1000

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        self.steps += 1
        return self.net(observation) * self.steps


def recurrent(kind: Any) -> ProbabilisticActor:
    memory = kind(input_size=3, hidden_size=4, in_key="observation", out_key="features")
    head = TensorDictModule(nn.Linear(4, 2), in_keys=["features"], out_keys=["logits"])
    return ProbabilisticActor(
        TensorDictSequential(memory, head), in_keys=["logits"], distribution_class=Categorical, return_log_prob=True
    )


@pytest.mark.parametrize("kind", [LSTMModule, GRUModule])
def test_hidden_states_among_the_keys_are_refused(kind: Any) -> None:
    with pytest.raises(NotImplementedError, match=r"a memory: it reads \[.*recurrent_state"):
        ActionPrior(recurrent(kind))


@pytest.mark.parametrize("kind", [Replaces, Overwrites])
def test_a_hidden_state_in_a_buffer_is_refused_at_every_call(kind: Any) -> None:
    prior = ModulePrior(kind(), "logits")
    for _ in range(2):
        with pytest.raises(NotImplementedError, match=r"a memory: it changed .*hidden"):
            prior.get_dist(TensorDict(observation=torch.randn(5, 3), batch_size=[5]))


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
@pytest.mark.parametrize("kind", [Replaces, Overwrites])
def test_so_is_one_in_torchscript(kind: Any) -> None:
    module = torch.jit.script(kind())
    with pytest.raises(NotImplementedError, match="it changed hidden"), without_memory(module), torch.no_grad():
        module(torch.randn(5, 3))
    plain = torch.jit.script(nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))).eval()
    with without_memory(plain), torch.no_grad():
        plain(torch.randn(5, 3))


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
@pytest.mark.parametrize("freeze", [False, True])
@pytest.mark.parametrize(("kind", "name"), [(Assigns, "hidden"), (Counts, "steps")])
def test_what_torchscript_assigns_to_itself_is_a_memory(kind: Any, name: str, freeze: bool) -> None:
    script = torch.jit.script(nn.Sequential(kind()).eval())
    prior = BoltzmannPrior(torch.jit.freeze(script) if freeze else script)
    with pytest.raises(NotImplementedError, match=rf"a memory: it changed .*\b{name} when"):
        prior.get_dist(TensorDict(observation=torch.randn(5, 3), batch_size=[5]))


def test_a_recurrence_within_one_observation_is_none() -> None:
    class Reads(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.rnn = nn.GRU(3, 2, batch_first=True)
            self.register_buffer("scale", torch.tensor(2.0))

        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            return self.scale * self.rnn(observation)[0][:, -1]

    prior, data = ModulePrior(Reads(), "logits"), TensorDict(observation=torch.randn(5, 7, 3), batch_size=[5])
    assert torch.equal(prior.get_dist(data).logits, prior.get_dist(data).logits)


def test_what_a_recurrent_teacher_wrote_can_advise() -> None:
    head = ProbabilisticTensorDictModule({"logits": "teacher_logits"}, ["action"], distribution_class=Categorical)
    prior = ActionPrior(head)
    ends = torch.zeros(6, 1, dtype=torch.bool)
    batch = TensorDict(
        observation=torch.randn(6, 3),
        action=torch.zeros(6, dtype=torch.long),
        teacher_logits=torch.randn(6, 2),
        next=TensorDict(observation=torch.randn(6, 3), done=ends, terminated=ends, batch_size=[6]),
        batch_size=[6],
    )
    out = PriorLogProb(prior, boundary="zero", time_dim=0)(batch)
    expected = batch["teacher_logits"].log_softmax(-1)[:, :1]
    torch.testing.assert_close(out["prior_log_prob"], expected)
    torch.testing.assert_close(out["next", "prior_log_prob"][:-1], expected[1:])
    net = TensorDictModule(nn.Linear(3, 2), in_keys=["observation"], out_keys=["logits"])
    student = ProbabilisticActor(net, in_keys=["logits"], distribution_class=Categorical)
    assert AE2RLoss(student, prior, method="kickstart")(out)["loss_prior"].isfinite()
