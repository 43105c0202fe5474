"""Operations that are recorded once, with their gradients, and run as one compiled graph from then on."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch._guards import TracingContext, tracing
from torch._inductor import standalone_compile
from torch._ops import OpOverload
from torch._subclasses import FakeTensorMode
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import disable_proxy_modes_tracing, make_fx
from torch.overrides import TorchFunctionMode


def record(step: Callable[..., Tensor], inputs: list[Tensor], backend: str) -> Callable[[list[Tensor]], Tensor]:
    """Runs a step once, on copies of its inputs, and compiles what happened, or replays it (``"eager"``)."""
    # Each operation is noted with fakes of its results: of one mode for all, as to make a mode takes as long.
    fakes = tracing(TracingContext(FakeTensorMode(allow_fallback_kernels=True)))
    with torch.random.fork_rng(devices=[]), _Decided(), fakes:
        graph = make_fx(step, decomposition_table=_FASTER)(*(tensor.clone() for tensor in inputs))
    graph.graph.eliminate_dead_code()
    graph.recompile()
    return _compile(graph, inputs) if backend != "eager" else lambda inputs: graph(*inputs)


def layout_of(tensor: Tensor) -> Hashable:
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

#: What hands the values of a tensor to Python.
_LEAVING = (Tensor.numpy, Tensor.__array__, Tensor.tolist)

_FASTER: dict[OpOverload, Callable[..., Any]] = {
    torch.ops.aten.tanh.default: _tanh,
    torch.ops.aten.addmm.default: _addmm,
}


def tensors_of(module: nn.Module) -> list[Tensor]:
    """The parameters and buffers of a module, each once."""
    return list({id(tensor): tensor for *_, tensor in _slots(module)}.values())


def _slots(module: nn.Module) -> Iterator[tuple[dict[str, Any], str, Tensor]]:
    """Where a module and those inside it keep parameters and buffers."""
    for child in module.modules():
        for entries in (child._parameters, child._buffers):
            yield from ((entries, name, tensor) for name, tensor in entries.items() if tensor is not None)


@contextmanager
def replaced(module: nn.Module, old: list[Tensor], new: list[Tensor]) -> Iterator[None]:
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
    """While operations are recorded, decisions that depend on data are taken by the data at hand.

    Values that leave torch are refused: what is made of them would be the same for every later minibatch.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is Tensor.__bool__:
            with disable_proxy_modes_tracing():
                return func(*args)
        if func in _LEAVING:
            raise RuntimeError(
                f"A compiled step can't record Tensor.{func.__name__}: what Python makes of the values would be that of"
                " the first minibatch in all others. If it is the prior that needs them, as a CallablePrior does, make"
                " the loss with prior_in_batch=True, and let prior_transforms(loss) run the prior."
            )
        return func(*args, **(kwargs or {}))
