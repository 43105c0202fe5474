"""A whole optimisation step of a TorchRL loss as one compiled graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torch._guards import TracingContext, tracing
from torch._inductor import standalone_compile
from torch._ops import OpOverload
from torch._subclasses import FakeTensorMode
from torch.fx import GraphModule
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
    the checks of arguments in ``torch.distributions``) is taken once. Look at the reported values to find NaNs.

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
        self._graphs: dict[Hashable, Callable[[list[Tensor]], Tensor]] = {}
        self._reached: dict[Hashable, list[list[Tensor]]] = {}

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
        values = [batch.get(key).contiguous() for key in keys]
        flats: list[_Flat] = []
        reports: list[Tensor] = []
        for index in indices:
            if not reports:
                flats = self._flatten(keys, values, index)
                trained = {id(parameter) for flat in flats for parameter in flat.parameters}
                others = [tensor for tensor in _tensors(self.loss) if id(tensor) not in trained]
                state = [tensor for flat in flats for tensor in flat.buffers]
                constants = [*(tensor.detach() for tensor in others), *values]
                layout = (keys, *(flat.layout for flat in flats), *map(_layout, constants))
            which = (layout, _layout(index))
            factors = torch.tensor([flat.factors(len(reports) + 1) for flat in flats], device=index.device)
            inputs = [*state, factors, *constants, index]
            if which not in self._graphs:
                self._graphs[which] = self._record(keys, flats, others, inputs)
            reports.append(self._graphs[which](inputs))
        for flat in flats:
            flat.write(len(reports))
        return torch.stack(reports)

    def _flatten(self, keys: tuple[NestedKey, ...], values: list[Tensor], index: Tensor) -> list[_Flat]:
        """The parameters that the losses reach and Adam's state of them, each group in one piece or few."""
        groups = self.optimizer.param_groups
        which = (keys, tuple(parameter.requires_grad for group in groups for parameter in group["params"]))
        if which not in self._reached:
            self._reached[which] = self._find_reached(keys, values, index)
        flats = []
        for number, parameters in enumerate(self._reached[which]):
            alike: dict[Hashable, list[Tensor]] = {}
            for parameter in parameters:
                state = self.optimizer.state[parameter]
                if not state:  # as Adam itself would begin
                    state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)
                    state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
                alike.setdefault((float(state["step"]), parameter.dtype, parameter.device), []).append(parameter)
            flats += [_Flat(self.optimizer, number, piece) for piece in alike.values()]
        return flats

    def _find_reached(self, keys: tuple[NestedKey, ...], values: list[Tensor], index: Tensor) -> list[list[Tensor]]:
        """The parameters of each of the optimizer's groups of which the losses have a gradient."""
        groups = [[p for p in group["params"] if p.requires_grad] for group in self.optimizer.param_groups]
        parameters = [parameter for group in groups for parameter in group]
        leaves = [parameter.detach().requires_grad_() for parameter in parameters]
        with torch.random.fork_rng(devices=[]), _replaced(self.loss, parameters, leaves):
            _, gradients = self._differentiate(keys, values, index, leaves)
        found = iter(gradients)
        return [[parameter for parameter in group if next(found) is not None] for group in groups]

    def _differentiate(
        self, keys: tuple[NestedKey, ...], values: list[Tensor], index: Tensor, leaves: list[Tensor]
    ) -> tuple[dict[str, Tensor], list[Tensor | None]]:
        """The loss of a minibatch, and the gradient of what is to be minimised."""
        minibatch = TensorDict({}, [len(index)])
        for key, value in zip(keys, values, strict=True):
            minibatch.set(key, value.index_select(0, index))
        with torch.enable_grad():
            losses = dict(self.loss(minibatch).items())
            minimised = [value for name, value in losses.items() if self._select(name)]
            if not minimised:
                raise ValueError(f"There is nothing to minimise among {list(losses)}.")
            return losses, list(torch.autograd.grad(sum(minimised), leaves, allow_unused=True))

    def _record(
        self, keys: tuple[NestedKey, ...], flats: list[_Flat], others: list[Tensor], inputs: list[Tensor]
    ) -> Callable[[list[Tensor]], Tensor]:
        """Takes a step on copies, and compiles what happened."""
        groups = self.optimizer.param_groups
        trained = [parameter for flat in flats for parameter in flat.parameters]

        def step(*tensors: Tensor) -> Tensor:
            rest = iter(tensors)
            states = [list(islice(rest, 3)) for _ in flats]
            factors = next(rest)
            copies = list(islice(rest, len(others)))
            *values, index = rest

            pieces = [piece for flat, state in zip(flats, states, strict=True) for piece in flat.split(state[0])]
            leaves = [piece.detach().requires_grad_() for piece in pieces]
            with _replaced(self.loss, [*trained, *others], [*leaves, *copies]):
                losses, gradients = self._differentiate(keys, values, index, leaves)
            self.names = list(losses)

            found = iter(gradients)
            joined = [flat.join(list(islice(found, len(flat.parameters)))) for flat in flats]
            for number, group in enumerate(groups):
                members = [i for i, flat in enumerate(flats) if flat.group == number]
                clipped = _clip([joined[i] for i in members], self.max_grad_norm)
                for i, gradient in zip(members, clipped, strict=True):
                    parameter, mean, square = states[i]
                    _adam(parameter, mean, square, gradient, factors[i], group["betas"], group["eps"])
            return torch.stack([value.detach().mean() for value in losses.values()])

        # Each operation is noted with fakes of its results: of one mode for all, as to make a mode takes as long.
        fakes = tracing(TracingContext(FakeTensorMode(allow_fallback_kernels=True)))
        with torch.random.fork_rng(devices=[]), _Decided(), fakes:
            graph = make_fx(step, decomposition_table=_FASTER)(*(tensor.clone() for tensor in inputs))
        graph.graph.eliminate_dead_code()
        graph.recompile()
        if self._backend == "eager":
            return lambda inputs: graph(*inputs)
        return _compile(graph, inputs)


class _Flat:
    """Parameters of one group at one step of Adam, and their state, end to end: few large operations, not many small.

    Each begins at a multiple of 64 bytes. The gaps are 0 and remain so.
    """

    def __init__(self, optimizer: torch.optim.Adam, group: int, parameters: list[Tensor]) -> None:
        self.group = group
        self.parameters = parameters
        self.options = optimizer.param_groups[group]
        self.states = [optimizer.state[parameter] for parameter in parameters]
        self.shapes = [parameter.shape for parameter in parameters]
        self.sizes = [-(-parameter.numel() // 16) * 16 for parameter in parameters]
        self.layout = (group, parameters[0].dtype, parameters[0].device, *self.shapes, *map(id, parameters))
        self.first = float(self.states[0]["step"])
        self.buffers = [parameters[0].new_zeros(sum(self.sizes)) for _ in range(3)]
        for buffer, tensors in zip(self.buffers, self._tensors(), strict=True):
            torch._foreach_copy_(self.split(buffer), tensors)

    def _tensors(self) -> list[list[Tensor]]:
        names = ("exp_avg", "exp_avg_sq")
        return [
            [parameter.detach() for parameter in self.parameters],
            *([state[name] for state in self.states] for name in names),
        ]

    def write(self, steps: int) -> None:
        """Back into the parameters and the optimizer, after so many steps."""
        for buffer, tensors in zip(self.buffers, self._tensors(), strict=True):
            torch._foreach_copy_(tensors, self.split(buffer))
        torch._foreach_add_([state["step"] for state in self.states], float(steps))

    def split(self, buffer: Tensor) -> list[Tensor]:
        """The parts of a buffer that are the parameters, in their shapes."""
        pieces, start = [], 0
        for shape, size in zip(self.shapes, self.sizes, strict=True):
            pieces.append(buffer[start : start + shape.numel()].view(shape))
            start += size
        return pieces

    def join(self, pieces: list[Tensor | None]) -> Tensor:
        """The inverse of :meth:`split`."""
        parts = []
        for piece, size in zip(pieces, self.sizes, strict=True):
            assert piece is not None
            parts.append(piece.reshape(-1))
            if size > piece.numel():
                parts.append(piece.new_zeros(size - piece.numel()))
        return torch.cat(parts)

    def factors(self, steps: int) -> tuple[float, float]:
        """Adam's step size and the scale of its second moment after so many more steps."""
        step, (beta, beta_sq) = self.first + steps, self.options["betas"]
        return float(self.options["lr"]) / (1 - beta**step), math.sqrt(1 - beta_sq**step)


def _layout(tensor: Tensor) -> Hashable:
    """What a compiled graph takes for granted of a tensor."""
    return tensor.shape, tensor.stride(), tensor.dtype, tensor.device


def _compile(graph: GraphModule, inputs: list[Tensor]) -> Callable[[list[Tensor]], Tensor]:
    """Compiled ahead of its calls: no guards on the inputs, which are known, and nothing to trace again.

    What is compiled is kept on disk by inductor, under the record itself and the versions: a second process finds it.
    """
    options = {"cpp_wrapper": inputs[-1].device.type == "cpu"}
    compiled = standalone_compile(
        graph,
        list(inputs),
        dynamic_shapes="from_example_inputs",
        options={"config_patches": options},
        donate_graph_module=True,
    )

    def call(inputs: list[Tensor]) -> Tensor:
        out: Any = compiled(*inputs)
        return out

    return call


def _tanh(x: Tensor) -> Tensor:
    """The tanh as a quotient of polynomials, within 4e-7: PyTorch's takes ten times as long in a compiled kernel."""
    if x.dtype != torch.float32:
        return NotImplemented
    x = x.clamp(-7.90531110763549805, 7.90531110763549805)
    square = x * x
    above, below = torch.full_like(x, _TANH_ABOVE[0]), torch.full_like(x, _TANH_BELOW[0])
    for coefficient in _TANH_ABOVE[1:]:
        above = above * square + coefficient
    for coefficient in _TANH_BELOW[1:]:
        below = below * square + coefficient
    return x * above / below


def _addmm(bias: Tensor, x: Tensor, weight: Tensor, *, beta: float = 1, alpha: float = 1) -> Tensor:
    """A product and then the bias, which is fused with the activation, as a difference lest it be recognised."""
    if beta != 1 or alpha != 1:
        return NotImplemented
    return torch.mm(x, weight) - (-bias)


# The coefficients of Eigen's tanh of floats.
_TANH_ABOVE = (
    -2.76076847742355e-16,
    2.00018790482477e-13,
    -8.60467152213735e-11,
    5.12229709037114e-08,
    1.48572235717979e-05,
    6.37261928875436e-04,
    4.89352455891786e-03,
)
_TANH_BELOW = (1.19825839466702e-06, 1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03)

_FASTER: dict[OpOverload, Callable[..., Any]] = {
    torch.ops.aten.tanh.default: _tanh,
    torch.ops.aten.addmm.default: _addmm,
}


def _tensors(module: nn.Module) -> list[Tensor]:
    """The parameters and buffers of a module, each once."""
    return list({id(tensor): tensor for *_, tensor in _slots(module)}.values())


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
        entries[name] = replacement.get(id(tensor), tensor)
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
    mean: Tensor,
    square: Tensor,
    gradient: Tensor,
    factors: Tensor,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """As :class:`torch.optim.Adam`, in place; the factors are those of :meth:`_Flat.factors`."""
    rate, scale = factors.unbind()
    mean.lerp_(gradient, 1 - betas[0])
    square.mul_(betas[1]).addcmul_(gradient, gradient, value=1 - betas[1])
    parameter.sub_(rate * mean / (square.sqrt() / scale + eps))
