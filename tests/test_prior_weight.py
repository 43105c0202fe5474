"""Claims about the weight of a prior."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import MLP

from torchrl_priors.prior_weight import PriorWeight

OBS = 3


def network() -> nn.Sequential:
    return nn.Sequential(nn.Linear(OBS, 16), nn.Tanh(), nn.Linear(16, 1))


def observations(*batch: int, scale: float = 1.0) -> TensorDict:
    return TensorDict(observation=scale * torch.randn(*batch, OBS), batch_size=batch)


class TestNetwork:
    @pytest.mark.parametrize("batch", [(), (5,), (2, 7)])
    def test_a_weight_is_a_sigmoid_of_the_network(self, batch: tuple[int, ...]) -> None:
        net = network()
        td = PriorWeight(net)(observations(*batch))
        assert td["prior_weight"].shape == (*batch, 1)
        torch.testing.assert_close(td["prior_weight"], net(td["observation"]).sigmoid())
        assert set(td.keys()) == {"observation", "prior_weight"}

    def test_starts_at_one_half_everywhere(self) -> None:
        weight = PriorWeight(network())(observations(100))["prior_weight"]
        assert (weight - 0.5).abs().max() < 0.01
        assert weight.std() > 0

    def test_initial_bias_sets_the_initial_trust(self) -> None:
        weight = PriorWeight(network(), init_bias=-4.0)(observations(100))["prior_weight"]
        torch.testing.assert_close(weight, torch.full_like(weight, 0.018), atol=1e-3, rtol=0)

    def test_only_the_last_layer_is_scaled(self) -> None:
        net = network()
        before = [parameter.clone() for parameter in net.parameters()]
        PriorWeight(net, init_scale=0.1)
        after = list(net.parameters())
        assert torch.equal(after[0], before[0])
        assert torch.equal(after[1], before[1])
        torch.testing.assert_close(after[2], 0.1 * before[2])
        assert after[3].item() == 0

    def test_network_is_left_alone_without_a_scale(self) -> None:
        net = network()
        before = [parameter.clone() for parameter in net.parameters()]
        PriorWeight(net, init_scale=None)
        assert all(torch.equal(a, b) for a, b in zip(net.parameters(), before, strict=True))

    def test_stays_in_the_unit_interval(self) -> None:
        weight = PriorWeight(network(), init_scale=1e6)(observations(100, scale=1e6))["prior_weight"]
        assert weight.min() >= 0
        assert weight.max() <= 1

    def test_reset_restores_the_scaled_initialisation(self) -> None:
        weight = PriorWeight(network(), init_bias=-1.0)
        old = [parameter.clone() for parameter in weight.parameters()]
        with torch.no_grad():
            for parameter in weight.parameters():
                parameter.fill_(7.0)
        weight.reset_parameters_recursive()
        self.assert_initial(weight, old)

    def test_reset_of_parameters_of_a_loss(self) -> None:
        weight = PriorWeight(network(), init_bias=-1.0)
        held = TensorDict.from_module(weight)
        new = weight.reset_parameters_recursive(held.clone())
        with new.to_module(weight):
            value = weight(observations(50))["prior_weight"]
        torch.testing.assert_close(value, torch.full_like(value, 0.2689), atol=5e-3, rtol=0)

    def test_a_reset_inside_a_sequence_scales_the_last_layer(self) -> None:
        weight = PriorWeight(network(), init_bias=-1.0)
        old = [parameter.clone() for parameter in weight.parameters()]
        TensorDictSequential(weight).reset_parameters_recursive()
        self.assert_initial(weight, old)

    @staticmethod
    def assert_initial(weight: PriorWeight, old: list[torch.Tensor]) -> None:
        first, _, last, bias = weight.parameters()
        assert not torch.equal(first, old[0])
        assert not torch.equal(last, old[2])
        assert 0 < last.abs().max() <= 0.01 * 16**-0.5
        assert bias.item() == -1.0

    def test_the_weight_reads_and_writes_the_keys_it_was_given(self) -> None:
        net = nn.Bilinear(OBS, 2, 1)
        weight = PriorWeight(
            net, in_keys=["observation", ("agent", "memory")], out_keys=[("agent", "w")], init_scale=None
        )
        td = observations(5).set("agent", TensorDict(memory=torch.randn(5, 2), batch_size=[5]))
        expected = net(td["observation"], td["agent", "memory"]).sigmoid()
        torch.testing.assert_close(weight(td)["agent", "w"], expected)

    def test_tensordict_module_and_dispatch(self) -> None:
        net = network()
        module = TensorDictModule(net, in_keys=["pixels"], out_keys=["logit"])
        weight = PriorWeight(module)
        observation = torch.randn(5, OBS)
        assert weight.in_keys == ["pixels"]
        torch.testing.assert_close(weight(pixels=observation), net(observation).sigmoid())

    def test_gradient_reaches_the_network(self) -> None:
        weight = PriorWeight(network())
        weight(observations(5))["prior_weight"].sum().backward()
        assert all((parameter.grad != 0).any() for parameter in weight.parameters())

    def test_bad_networks_are_refused(self) -> None:
        with pytest.raises(ValueError, match="no linear layer"):
            PriorWeight(nn.Bilinear(OBS, 2, 1))
        with pytest.raises(ValueError, match="one output"):
            PriorWeight(nn.Linear(OBS, 2))
        with pytest.raises(ValueError, match="lazy"):
            PriorWeight(MLP(out_features=1))
        with pytest.raises(ValueError, match="no bias"):
            PriorWeight(nn.Linear(OBS, 1, bias=False), init_bias=-1.0)
        with pytest.raises(ValueError, match="one entry"):
            PriorWeight(network(), out_keys=["a", "b"])
        with pytest.raises(ValueError, match="own in_keys"):
            PriorWeight(TensorDictModule(network(), in_keys=["pixels"], out_keys=["logit"]), in_keys=["observation"])
        with pytest.raises(ValueError, match=r"\[\*B, 1\]"):
            PriorWeight(nn.Flatten(), init_scale=None)(observations(5))


class TestTable:
    def test_starts_at_one_half_and_learns_state_by_state(self) -> None:
        weight = PriorWeight.table(4)
        td = weight(TensorDict(state=torch.tensor([1, 3, 1]), batch_size=[3]))
        assert torch.equal(td["prior_weight"], torch.full((3, 1), 0.5))
        td["prior_weight"].sum().backward()
        (logits,) = weight.parameters()
        torch.testing.assert_close(logits.grad.squeeze(-1), torch.tensor([0.0, 0.5, 0.0, 0.25]))

    def test_each_world_has_its_own_weights(self) -> None:
        weight = PriorWeight.table(4, key=("agent", "cell"), batch=(2,), out_keys=["w"])
        (logits,) = weight.parameters()
        logits.data.copy_(torch.randn_like(logits))
        state = torch.randint(4, (2, 7, 1))
        td = TensorDict(agent=TensorDict(cell=state, batch_size=[2, 7]), batch_size=[2, 7])
        expected = torch.stack([logits[world, state[world, :, 0]] for world in range(2)]).sigmoid()
        torch.testing.assert_close(weight(td)["w"], expected)

    def test_reset_returns_to_one_half(self) -> None:
        weight = PriorWeight.table(4)
        (logits,) = weight.parameters()
        logits.data.fill_(3.0)
        new = weight.reset_parameters_recursive(TensorDict.from_module(weight).clone())
        assert all((value == 0).all() for value in new.values(True, True))
        assert (logits == 3.0).all()
        weight.reset_parameters_recursive()
        assert (logits == 0).all()

    @pytest.mark.parametrize("state", [-1, 4])
    @pytest.mark.parametrize("worlds", [(), (1,)])
    def test_a_state_that_is_not_in_the_table_is_an_error(self, state: int, worlds: tuple[int, ...]) -> None:
        weight = PriorWeight.table(4, batch=worlds)
        with pytest.raises(IndexError):
            weight(TensorDict(state=torch.full((*worlds, 3), state), batch_size=[*worlds, 3]))

    def test_a_table_needs_a_state(self) -> None:
        with pytest.raises(ValueError, match="at least one state"):
            PriorWeight.table(0)


class TestConstant:
    @pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
    def test_a_constant_weight_is_exact_and_not_learned(self, value: float) -> None:
        weight = PriorWeight.constant(value)
        td = weight(TensorDict(batch_size=[2, 5]))
        assert torch.equal(td["prior_weight"], torch.full((2, 5, 1), value))
        assert not list(weight.parameters())
        assert isinstance(weight, PriorWeight)

    def test_state_dict_holds_the_value(self) -> None:
        weight = PriorWeight.constant(0.0)
        weight.load_state_dict(PriorWeight.constant(0.7).state_dict())
        assert weight(TensorDict(batch_size=[1]))["prior_weight"].item() == pytest.approx(0.7)

    def test_a_reset_keeps_a_constant_weight(self) -> None:
        weight = PriorWeight.constant(0.7)
        weight.reset_parameters_recursive()
        assert weight(TensorDict(batch_size=[1]))["prior_weight"].item() == pytest.approx(0.7)

    @pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
    def test_must_be_in_the_unit_interval(self, value: float) -> None:
        with pytest.raises(ValueError, match=r"in \[0, 1\]"):
            PriorWeight.constant(value)
