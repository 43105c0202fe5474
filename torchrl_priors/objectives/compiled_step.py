"""A whole optimisation step of a TorchRL loss as one compiled graph."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from itertools import islice

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn

from .flat_adam import FlatParameters, adam, clip
from .recorded import layout_of, record, replaced, tensors_of


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
    the checks of arguments in ``torch.distributions``) is taken once. Look at the reported values to find NaNs. A prior
    that runs Python on the values, as :class:`~torchrl_priors.CallablePrior` does, is refused: make the loss with
    ``prior_in_batch=True``.

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
        RuntimeError: at call, a loss that hands values of tensors to Python.

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
        self._rest: tuple[int, ...] = ()  # of the batch, behind the dimension that is indexed
        self._graphs: dict[Hashable, tuple[Callable[[list[Tensor]], Tensor], list[str]]] = {}
        self._reached: dict[Hashable, list[list[Tensor]]] = {}

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase, indices: Iterable[Tensor]) -> Tensor:
        """Take a step on ``batch[index]`` for each of the indices, in turn.

        Args:
            batch (TensorDictBase): ``[N]``, or ``[N, T]`` of sequences, with what the loss reads and little else.
            indices (iterable of Tensor): integers, ``[M]`` each. Each length is recorded and compiled apart.

        Returns:
            Tensor: the means of all that the loss puts out, ``[steps, len(names)]``; :attr:`names` says what they are.
        """
        self._rest = tuple(batch.batch_size[1:])
        keys = tuple(sorted(batch.keys(True, True), key=str))  # one graph whatever their order, also on disk
        values = [batch.get(key).contiguous() for key in keys]
        flats: list[FlatParameters] = []
        reports: list[Tensor] = []
        for index in indices:
            if not reports:
                flats = self._flatten(keys, values, index)
                trained = {id(parameter) for flat in flats for parameter in flat.parameters}
                others = [tensor for tensor in tensors_of(self.loss) if id(tensor) not in trained]
                state = [tensor for flat in flats for tensor in flat.buffers]
                constants = [*(tensor.detach() for tensor in others), *values]
                settings = (self.max_grad_norm, *((g["betas"], g["eps"]) for g in self.optimizer.param_groups))
                layout = (self._rest, keys, settings, *(flat.layout for flat in flats), *map(layout_of, constants))
            which = (layout, layout_of(index))
            factors = torch.tensor([flat.factors(len(reports) + 1) for flat in flats], device=index.device)
            inputs = [*state, factors, *constants, index]
            if which not in self._graphs:
                self._graphs[which] = self._record(keys, flats, others, inputs)
            graph, self.names = self._graphs[which]
            reports.append(graph(inputs))
        for flat in flats:
            flat.write(len(reports))
        return torch.stack(reports)

    def _flatten(self, keys: tuple[NestedKey, ...], values: list[Tensor], index: Tensor) -> list[FlatParameters]:
        """The parameters that the losses reach and Adam's state of them, each group in one piece or few."""
        groups = self.optimizer.param_groups
        which = (self._rest, keys, tuple(parameter.requires_grad for group in groups for parameter in group["params"]))
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
            flats += [FlatParameters(self.optimizer, number, piece) for piece in alike.values()]
        return flats

    def _find_reached(self, keys: tuple[NestedKey, ...], values: list[Tensor], index: Tensor) -> list[list[Tensor]]:
        """The parameters of each of the optimizer's groups of which the losses have a gradient."""
        groups = [[p for p in group["params"] if p.requires_grad] for group in self.optimizer.param_groups]
        parameters = [parameter for group in groups for parameter in group]
        leaves = [parameter.detach().requires_grad_() for parameter in parameters]
        with torch.random.fork_rng(devices=[]), replaced(self.loss, parameters, leaves):
            _, gradients = self._differentiate(keys, values, index, leaves)
        found = iter(gradients)
        return [[parameter for parameter in group if next(found) is not None] for group in groups]

    def _differentiate(
        self, keys: tuple[NestedKey, ...], values: list[Tensor], index: Tensor, leaves: list[Tensor]
    ) -> tuple[dict[str, Tensor], list[Tensor | None]]:
        """The loss of a minibatch, and the gradient of what is to be minimised."""
        minibatch = TensorDict({}, [len(index), *self._rest])
        for key, value in zip(keys, values, strict=True):
            minibatch.set(key, value.index_select(0, index))
        with torch.enable_grad():
            losses = dict(self.loss(minibatch).items())
            minimised = [value for name, value in losses.items() if self._select(name)]
            if not minimised:
                raise ValueError(f"There is nothing to minimise among {list(losses)}.")
            return losses, list(torch.autograd.grad(sum(minimised), leaves, allow_unused=True))

    def _record(
        self, keys: tuple[NestedKey, ...], flats: list[FlatParameters], others: list[Tensor], inputs: list[Tensor]
    ) -> tuple[Callable[[list[Tensor]], Tensor], list[str]]:
        """Takes a step on copies, and compiles what happened; the graph, and the names of what it reports."""
        groups = self.optimizer.param_groups
        trained = [parameter for flat in flats for parameter in flat.parameters]
        names: list[str] = []

        def step(*tensors: Tensor) -> Tensor:
            rest = iter(tensors)
            states = [list(islice(rest, 3)) for _ in flats]
            factors = next(rest)
            copies = list(islice(rest, len(others)))
            *values, index = rest

            pieces = [piece for flat, state in zip(flats, states, strict=True) for piece in flat.split(state[0])]
            leaves = [piece.detach().requires_grad_() for piece in pieces]
            with replaced(self.loss, [*trained, *others], [*leaves, *copies]):
                losses, gradients = self._differentiate(keys, values, index, leaves)
            names[:] = losses

            found = iter(gradients)
            joined = [flat.join(list(islice(found, len(flat.parameters)))) for flat in flats]
            for number, group in enumerate(groups):
                members = [i for i, flat in enumerate(flats) if flat.group == number]
                clipped = clip([joined[i] for i in members], self.max_grad_norm)
                for i, gradient in zip(members, clipped, strict=True):
                    parameter, mean, square = states[i]
                    adam(parameter, mean, square, gradient, factors[i], group["betas"], group["eps"])
            return torch.stack([value.detach().mean() for value in losses.values()])

        return record(step, inputs, self._backend), names
