"""Claims about priors of action values, uniform priors, and tables of states."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    TensorDictModule,
)
from test_priors import ACTIONS, OBS, observations
from torch import distributions as d
from torch import nn
from torchrl.data import Binary, Bounded, Categorical, OneHot, Unbounded
from torchrl.modules import (
    MaskedOneHotCategorical,
    OneHotCategorical,
    ProbabilisticActor,
    QValueActor,
)

from torchrl_priors.distributions import cross_entropy
from torchrl_priors.priors import ActionPrior, BoltzmannPrior, UniformPrior
from torchrl_priors.state_table import StateTable


class TestBoltzmannPrior:
    Q = torch.tensor([[0.0, 1.0, 2.0], [3.0, 3.0, -1.0]])

    def test_a_boltzmann_prior_is_the_softmax_of_the_table(self) -> None:
        batch = TensorDict(state=torch.tensor([[0, 1, 1]]), batch_size=[1, 3])
        probs = BoltzmannPrior(self.Q, 0.5).get_dist(batch).probs
        torch.testing.assert_close(probs, (self.Q / 0.5).softmax(-1)[[0, 1, 1]].unsqueeze(0))

    def test_adversary_is_the_softmax_of_minus_q(self) -> None:
        batch = TensorDict(state=torch.tensor([0, 1]), batch_size=[2])
        probs = BoltzmannPrior(self.Q, 2.0).adversary().get_dist(batch).probs
        torch.testing.assert_close(probs, (-self.Q / 2.0).softmax(-1))

    def test_table_and_network_agree(self) -> None:
        net = nn.Linear(2, 3, bias=False)
        net.weight.data.copy_(self.Q.T)
        states = torch.tensor([0, 1, 1, 0])
        by_table = BoltzmannPrior(self.Q).get_dist(TensorDict(state=states, batch_size=[4]))
        one_hot = nn.functional.one_hot(states).float()
        by_net = BoltzmannPrior(net).get_dist(TensorDict(observation=one_hot, batch_size=[4]))
        torch.testing.assert_close(by_table.probs, by_net.probs)

    def test_value_actor_is_a_teacher(self) -> None:
        net = nn.Linear(OBS, ACTIONS)
        actor = QValueActor(net, in_keys=["observation"], spec=OneHot(ACTIONS))
        batch = actor(observations(5))
        before = batch.clone()
        prior = BoltzmannPrior(actor, 0.3, distribution_class=OneHotCategorical)
        torch.testing.assert_close(prior.get_dist(batch).probs, (net(batch["observation"]) / 0.3).softmax(-1))
        assert prior.log_prob(batch).shape == (5,)
        assert set(batch.keys()) == set(before.keys())

    def test_each_world_has_its_own_table(self) -> None:
        q = torch.randn(2, 5, ACTIONS)
        state = torch.randint(5, (2, 7))
        for key_shape in (state, state.unsqueeze(-1)):
            batch = TensorDict(state=key_shape, batch_size=[2, 7])
            logits = BoltzmannPrior(q).get_dist(batch).logits
            for world in range(2):
                torch.testing.assert_close(logits[world], q[world, state[world]].log_softmax(-1))

    def test_states_of_other_worlds_are_refused(self) -> None:
        prior = BoltzmannPrior(torch.zeros(2, 5, ACTIONS))
        with pytest.raises(ValueError, match="leading dimensions"):
            prior.get_dist(TensorDict(state=torch.zeros(7, dtype=torch.int64), batch_size=[7]))
        for state in (5, -1):
            with pytest.raises(IndexError, match="state"):
                prior.get_dist(TensorDict(state=torch.full((2, 7), state), batch_size=[2, 7]))

    @pytest.mark.parametrize("as_table", [True, False])
    @pytest.mark.parametrize("value", [float("nan"), float("inf")])
    def test_nan_in_q_is_refused(self, value: float, as_table: bool) -> None:
        q = self.Q.clone()
        q[1, 2] = value
        net = TensorDictModule(lambda state: q[state], in_keys=["state"], out_keys=["action_value"])
        batch = TensorDict(state=torch.tensor([0, 1]), batch_size=[2])
        with pytest.raises(ValueError, match="Action values"):
            BoltzmannPrior(q if as_table else net).get_dist(batch)

    def test_unavailable_actions_stay_unavailable_to_the_adversary(self) -> None:
        q = torch.tensor([[0.0, 1.0, -torch.inf]])
        prior = BoltzmannPrior(q)
        batch = TensorDict(state=torch.tensor([0]), batch_size=[1])
        torch.testing.assert_close(
            prior.adversary().get_dist(batch).probs, torch.tensor([[0.7311, 0.2689, 0.0]]), atol=1e-4, rtol=0
        )
        with pytest.raises(ValueError, match="no action is available"):
            BoltzmannPrior(torch.full((1, 3), -torch.inf))

    @pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan"), float("inf")])
    def test_temperature_must_be_positive(self, temperature: float) -> None:
        with pytest.raises(ValueError, match="temperature"):
            BoltzmannPrior(self.Q, temperature)

    @pytest.mark.parametrize("state", [torch.tensor([0.0, 1.0]), torch.tensor([True, False])])
    def test_states_must_be_integers(self, state: torch.Tensor) -> None:
        with pytest.raises(ValueError, match="integer"):
            BoltzmannPrior(self.Q).get_dist(TensorDict(state=state, batch_size=[2]))

    def test_a_boltzmann_prior_has_a_table_of_its_own(self) -> None:
        q = self.Q.clone()
        prior = BoltzmannPrior(q)
        q.zero_()
        batch = TensorDict(state=torch.tensor([0]), batch_size=[1])
        torch.testing.assert_close(prior.get_dist(batch).probs, self.Q[:1].softmax(-1))

    def test_ambiguous_settings_are_refused(self) -> None:
        with pytest.raises(ValueError, match="one key"):
            BoltzmannPrior(self.Q, in_keys=["row", "column"])
        net = TensorDictModule(nn.Linear(OBS, ACTIONS), in_keys=["observation"], out_keys=["q"])
        with pytest.raises(ValueError, match="nope"):
            BoltzmannPrior(net, action_value_key="nope")


class TestUniformPrior:
    @pytest.mark.parametrize(
        ("actions", "action"),
        [
            (4, torch.tensor([3, 0])),
            (Categorical(4), torch.tensor([3, 0])),
            (OneHot(4), torch.eye(4)[[3, 0]]),
            (Bounded(-1.0, 3.0, shape=(1,)), torch.tensor([[0.1], [2.0]])),
        ],
    )
    def test_every_action_is_as_probable(self, actions: object, action: torch.Tensor) -> None:
        log_prob = UniformPrior(actions).log_prob(TensorDict(action=action, batch_size=[2]))
        torch.testing.assert_close(log_prob, -torch.log(torch.tensor([4.0, 4.0])))

    def test_actions_that_the_environment_clips_score_as_their_bounds(self) -> None:
        prior = UniformPrior(Bounded(torch.tensor([0.0, 0.0]), torch.tensor([2.0, 1.0])))
        batch = TensorDict(action=torch.tensor([[0.0, 1.0], [2.0, 0.5], [2.1, -9.0]]), batch_size=[3])
        torch.testing.assert_close(prior.log_prob(batch), torch.full((3,), 2.0).log().neg())
        student = d.Independent(d.Normal(torch.zeros(3, 2), torch.full((3, 2), 5.0)), 1)
        torch.testing.assert_close(cross_entropy(student, prior.get_dist(batch)), torch.full((3,), 2.0).log())

    @pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
    def test_a_uniform_prior_is_uniform_over_actions_of_any_shape(self, shape: tuple[int, ...]) -> None:
        prior = UniformPrior(Bounded(-1.0, 1.0, shape=shape))
        log_prob = prior.log_prob(TensorDict(action=torch.zeros(5, 2, *shape), batch_size=[5, 2]))
        count = torch.Size(shape).numel()
        torch.testing.assert_close(log_prob, torch.full((5, 2), -count * torch.log(torch.tensor(2.0)).item()))

    def test_cross_entropy_to_it_is_the_log_of_the_number_of_actions(self) -> None:
        student = d.Categorical(logits=torch.randn(5, 4))
        prior = UniformPrior(4)
        batch = TensorDict(batch_size=[5])
        torch.testing.assert_close(
            cross_entropy(student, prior.get_dist(batch)), torch.full((5,), 4.0).log(), atol=1e-6, rtol=0
        )
        assert prior.adversary() is prior

    def test_actions_without_a_uniform_distribution_are_refused(self) -> None:
        with pytest.raises(ValueError, match="at least one"):
            UniformPrior(0)
        with pytest.raises(ValueError, match="unbounded"):
            UniformPrior(Bounded(-torch.inf, torch.inf, shape=(2,)))
        for spec in (Unbounded((2,)), Binary(3), Categorical(4, shape=(2,)), OneHot(4, shape=(2, 4)), "4"):
            with pytest.raises(TypeError, match="Expected a number"):
                UniformPrior(spec)


@given(worlds=st.integers(1, 3), states=st.integers(1, 4), time=st.integers(1, 4), features=st.lists(st.integers(1, 2)))
def test_state_table_reads_the_entry_of_each_world_and_state(
    worlds: int, states: int, time: int, features: list[int]
) -> None:
    table = torch.arange(worlds * states * torch.Size(features).numel()).reshape(worlds, states, *features)
    state = torch.randint(states, (worlds, time))
    module = StateTable(table, in_key="state", out_key="value", feature_dims=len(features))
    value: TensorDictBase = module(TensorDict(state=state, batch_size=[worlds, time]))
    for world in range(worlds):
        for step in range(time):
            assert torch.equal(value["value"][world, step], table[world, state[world, step]])


def test_learned_table_can_be_reset_and_a_given_one_stays() -> None:
    learned = StateTable(nn.Parameter(torch.ones(3)), in_key="state", out_key="value")
    given = StateTable(torch.ones(3), in_key="state", out_key="value")
    learned.reset_parameters_recursive()
    with pytest.warns(UserWarning, match="did not find any parameters"):
        given.reset_parameters_recursive()
    assert torch.equal(learned.table.detach(), torch.zeros(3))
    assert torch.equal(given.table, torch.ones(3))


def test_masked_one_hot_policies_are_scored() -> None:
    class Masked(nn.Module):
        def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return observation, observation > -10

    net = TensorDictModule(Masked(), in_keys=["observation"], out_keys=["logits", "mask"])
    actor = ProbabilisticActor(net, in_keys=["logits", "mask"], distribution_class=MaskedOneHotCategorical)
    batch = actor(observations(5))
    expected = batch["observation"].log_softmax(-1)[batch["action"].bool()]
    torch.testing.assert_close(ActionPrior(actor).log_prob(batch), expected)
