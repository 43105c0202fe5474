"""A whole optimisation step of a TorchRL loss as one compiled graph."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.fx.experimental.proxy_tensor import disable_proxy_modes_tracing, make_fx
from torch.overrides import TorchFunctionMode

__all__ = ["CompiledStep"]


class CompiledStep:
    r"""Steps of Adam on minibatches, each one compiled graph: index, losses, gradients, clipping and update at once.

    With the small networks of continuous control, most of the time of a PPO step is not arithmetic: it is Python around
    distributions and tensordicts, and the bookkeeping of a thousand tiny operations. Here the loss, whichever it is, is
    run once while its operations are recorded, with those of its gradient and of the optimizer behind them; the record
    is compiled, and from then on a step is one call. It replaces ::

        for index in indices:
            losses = loss(batch[index])
            sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
            for group in optimizer.param_groups:
                torch.nn.utils.clip_grad_norm_(group["params"], max_grad_norm)
            optimizer.step()
            optimizer.zero_grad()

    and computes the same, up to rounding. Parameters, buffers of the loss, learning rates and the state of the
    optimizer are those of the ordinary objects, which can be saved, loaded, scheduled and used without it at any time.

    What is recorded is one path through the code: a decision that the loss takes in Python by looking at data (such as
    the checks of arguments in :mod:`torch.distributions`) is taken once. Look at the reported values to find NaNs.

    Args:
        loss (LossModule): of scalar losses, with ``functional=False`` where it has the choice.
        optimizer (torch.optim.Adam): without weight decay and variants. Parameters that the losses do not reach stay.

    Keyword Args:
        max_grad_norm (float, optional): of the parameters of each of the optimizer's groups, apart. Defaults to
            ``None``: gradients are not clipped.
        select (callable, optional): whether to minimise an entry of the loss' output, by name. Defaults to all whose
            names begin with ``"loss_"``.
        backend (str): ``"inductor"`` needs a C++ compiler, and half a minute where its cache is cold; ``"eager"``
            replays the record without compiling it. Defaults to ``"inductor"``.

    Raises:
        TypeError: the optimizer is no Adam.
        ValueError: one of Adam's variants, or a functional loss.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import ProbabilisticActor, ValueOperator
        >>> from torchrl.objectives import ClipPPOLoss
        >>> net = TensorDictModule(torch.nn.Linear(3, 2), in_keys=["observation"], out_keys=["logits"])
        >>> actor = ProbabilisticActor(net, in_keys=["logits"], distribution_class=torch.distributions.Categorical)
        >>> critic = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
        >>> loss = ClipPPOLoss(actor, critic, functional=False)
        >>> batch = TensorDict(
        ...     observation=torch.randn(64, 3),
        ...     action=torch.zeros(64, dtype=torch.long),
        ...     action_log_prob=-torch.ones(64),
        ...     advantage=torch.randn(64, 1),
        ...     value_target=torch.randn(64, 1),
        ...     batch_size=[64],
        ... )
        >>> step = CompiledStep(loss, torch.optim.Adam(loss.parameters()), max_grad_norm=0.5, backend="eager")
        >>> reports = step(batch, torch.randperm(64).split(16))
        >>> reports.shape == (4, len(step.names)), "loss_critic" in step.names
        (True, True)

    """

    names: list[str]
    """What a step reports, in this order. Known after the first step."""

    def __init__(
        self,
        loss: nn.Module,
        optimizer: torch.optim.Adam,
        *,
        max_grad_norm: float | None = None,
        select: Callable[[str], bool] | None = None,
        backend: str = "inductor",
    ) -> None:
        if not isinstance(optimizer, torch.optim.Adam):
            raise TypeError(f"Only torch.optim.Adam can be compiled into a step, got {type(optimizer).__name__}.")
        for group in optimizer.param_groups:
            for option in ("weight_decay", "amsgrad", "maximize", "capturable", "differentiable"):
                if group[option]:
                    raise ValueError(f"A compiled step has no {option}, got {group[option]}.")
        if getattr(loss, "functional", False):
            raise ValueError("A compiled step needs a loss with functional=False.")
        self.loss = loss
        self.optimizer = optimizer
        self.max_grad_norm = max_grad_norm
        self.names = []
        self._select = select if select is not None else lambda name: name.startswith("loss_")
        self._backend = backend
        self._graphs: dict[Hashable, Callable[..., Tensor]] = {}

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase, indices: Iterable[Tensor]) -> Tensor:
        """Take a step on ``batch[index]`` for each of the indices, in turn.

        Args:
            batch (TensorDictBase): ``[N]``, with the entries that the loss reads and few others.
            indices (iterable of Tensor): integers, ``[M]`` each. Each length is recorded and compiled apart.

        Returns:
            Tensor: the means of all that the loss puts out, ``[steps, len(names)]``; :attr:`names` says what they are.
        """
        keys = tuple(sorted(batch.keys(True, True), key=str))  # one graph whatever their order, also on disk
        rates = [torch.tensor(group["lr"], dtype=torch.float32) for group in self.optimizer.param_groups]
        tensors = [*self._state(), *rates, *(batch.get(key) for key in keys)]
        frozen = tuple(p.requires_grad for group in self.optimizer.param_groups for p in group["params"])
        reports = []
        for index in indices:
            which = (keys, len(index), frozen)
            graph = self._graphs.get(which)
            if graph is None:
                graph = self._graphs[which] = self._record(keys, tensors, index)
            reports.append(graph(*tensors, index))
        return torch.stack(reports)

    def _state(self) -> list[Tensor]:
        """What a step reads and writes: parameters, Adam's state, and what else the loss has."""
        states = [self.optimizer.state[parameter] for parameter in self._trained]
        for parameter, state in zip(self._trained, states, strict=True):
            if not state:  # as Adam itself would begin
                state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        adam = [state[name] for name in ("step", "exp_avg", "exp_avg_sq") for state in states]
        return [
            *(parameter.detach() for parameter in self._trained),
            *adam,
            *(tensor.detach() for tensor in self._others()),
        ]

    @property
    def _trained(self) -> list[Tensor]:
        return [parameter for group in self._groups for parameter in group]

    @property
    def _groups(self) -> list[list[Tensor]]:
        """The parameters of each group of the optimizer that are not frozen."""
        return [[p for p in group["params"] if p.requires_grad] for group in self.optimizer.param_groups]

    def _others(self) -> list[Tensor]:
        trained = set(map(id, self._trained))
        tensors = {id(tensor): tensor for *_, tensor in _slots(self.loss)}
        return [tensor for key, tensor in tensors.items() if key not in trained]

    def _record(self, keys: tuple[NestedKey, ...], tensors: list[Tensor], index: Tensor) -> Callable[..., Tensor]:
        """Takes a step on copies, and compiles what happened."""
        trained, others = self._trained, self._others()

        def step(*tensors: Tensor) -> Tensor:
            rest = iter(tensors)
            parameters, steps, means, squares = (list(islice(rest, len(trained))) for _ in range(4))
            copies = list(islice(rest, len(others)))
            rates = list(islice(rest, len(self.optimizer.param_groups)))
            *values, index = rest

            leaves = [parameter.detach().requires_grad_() for parameter in parameters]
            minibatch = TensorDict({}, [len(index)])
            for key, value in zip(keys, values, strict=True):
                minibatch.set(key, value.index_select(0, index))
            with torch.enable_grad(), _replaced(self.loss, [*trained, *others], [*leaves, *copies]):
                losses = self.loss(minibatch)
                minimised = [value for name, value in losses.items() if self._select(name)]
                if not minimised:
                    raise ValueError(f"There is nothing to minimise among {list(losses.keys())}.")
                gradients = torch.autograd.grad(sum(minimised), leaves, allow_unused=True)
            self.names = list(losses.keys())

            end = 0
            for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
                start, end = end, end + sum(parameter.requires_grad for parameter in group["params"])
                reached = [i for i in range(start, end) if gradients[i] is not None]
                clipped = _clip([gradients[i] for i in reached], self.max_grad_norm)
                for i, gradient in zip(reached, clipped, strict=True):
                    _adam(parameters[i], gradient, steps[i], means[i], squares[i], rate, group["betas"], group["eps"])
            return torch.stack([value.detach().mean() for value in losses.values()])

        with torch.random.fork_rng(devices=[]), _Decided():
            graph = make_fx(step, decomposition_table=_FASTER)(*(tensor.clone() for tensor in tensors), index)
        graph.graph.eliminate_dead_code()
        graph.recompile()
        if self._backend == "eager":
            return graph
        return torch.compile(graph, backend=self._backend, options={"cpp_wrapper": index.device.type == "cpu"})


# PyTorch's tanh takes several times as long as its sigmoid; the difference is some 1e-7.
_FASTER = {torch.ops.aten.tanh.default: lambda x: 2 * torch.sigmoid(2 * x) - 1}


def _slots(module: nn.Module) -> Iterator[tuple[dict[str, Any], str, Tensor]]:
    """Where a module and those inside it keep parameters and buffers."""
    for child in module.modules():
        for entries in (child._parameters, child._buffers):
            yield from ((entries, name, tensor) for name, tensor in entries.items() if tensor is not None)


@contextmanager
def _replaced(module: nn.Module, old: list[Tensor], new: list[Tensor]) -> Iterator[None]:
    """The module with other tensors as its parameters and buffers."""
    replacement = {id(tensor): other for tensor, other in zip(old, new, strict=True)}
    slots = list(_slots(module))
    for entries, name, tensor in slots:
        entries[name] = replacement[id(tensor)]
    try:
        yield
    finally:
        for entries, name, tensor in slots:
            entries[name] = tensor


class _Decided(TorchFunctionMode):
    """While operations are recorded, decisions that depend on data are taken by the data at hand."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is Tensor.__bool__:
            with disable_proxy_modes_tracing():
                return func(*args)
        return func(*args, **(kwargs or {}))


def _clip(gradients: list[Tensor], max_norm: float | None) -> list[Tensor]:
    """As :func:`torch.nn.utils.clip_grad_norm_`."""
    if max_norm is None or not gradients:
        return gradients
    norm = torch.stack([gradient.square().sum() for gradient in gradients]).sum().sqrt()
    factor = (max_norm / (norm + 1e-6)).clamp(max=1.0)
    return [gradient * factor for gradient in gradients]


def _adam(
    parameter: Tensor,
    gradient: Tensor,
    step: Tensor,
    mean: Tensor,
    square: Tensor,
    rate: Tensor,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """As :class:`torch.optim.Adam`, in place."""
    step.add_(1)
    mean.lerp_(gradient, 1 - betas[0])
    square.mul_(betas[1]).addcmul_(gradient, gradient, value=1 - betas[1])
    root = square.sqrt() / (1 - betas[1] ** step).sqrt() + eps
    parameter.sub_(rate / (1 - betas[0] ** step) * mean / root)
