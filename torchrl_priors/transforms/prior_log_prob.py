"""Log-probabilities of what the student did under a prior, and their one-step shift."""

from __future__ import annotations

import warnings
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor

from torchrl_priors.distributions import cross_entropy
from torchrl_priors.functional import has_next_action, joint, shift_to_next
from torchrl_priors.keys import (
    check_advice,
    check_option,
    next_step,
    read,
    under_next,
    warn_of_another_teacher,
    without_padding,
)
from torchrl_priors.priors import Prior
from torchrl_priors.transforms.batch_transform import BatchTransform


class PriorLogProb(BatchTransform):
    r"""Writes :math:`\log\pi_0(a_t|s_t)`, and :math:`\log\pi_0(a_{t+1}|s_{t+1})` under ``"next"``.

    The first stage of reward shaping by a soft action prior (Centa & Preux, "Soft Action Priors: Towards Robust Policy
    Transfer"): ER rewards the first entry, E2R the second. It runs once a batch, without gradient. The entry of the
    next step is

    1. 0 where the episode terminated at t;
    2. that of step t + 1 where there is one: not after a step that is done, nor where trajectory ids differ (the seams
       between workers of a collector, whose ``done`` is false), nor at the end of the batch;
    3. elsewhere, where no next action was sampled, what ``boundary`` says of the next state.

    Args:
        prior (Prior): the prior; it also says where the action is (:meth:`Prior.set_keys`). What it draws at random is
            left in the batch, for the step and for the next one.
        actor (ProbabilisticTensorDictSequential, optional): the student :math:`\pi`, for ``boundary``. It is used as it
            is when a batch arrives, and is no submodule of the transform: moving or saving the transform leaves it
            alone.

    Keyword Args:
        time_dim (int, optional): the batch dimension along which time runs. Defaults to ``None``: the one named
            ``"time"``, as in what collectors and rollouts return.
        boundary ("expected", "sample" or "zero"): ``"expected"`` (default) is :math:`-H^X_{s'}(\pi\|\pi_0)`, the mean
            over the student's next action, in closed form where there is one; ``"sample"`` is the log-probability of an
            action drawn from the student; ``"zero"`` is no advice.
        keep_params (bool): also leave the parameters of the prior's distribution at each step in the batch, under
            ``prior.out_keys``, e.g. ``("prior", "loc")``: losses with ``prior_in_batch=True`` need not run the prior
            again. They are right as long as the observations in the batch are not changed. Defaults to ``False``.
        num_samples (int, optional): for a cross-entropy without a closed form. Defaults to ``None``: 1.
        out_keys (list of NestedKey, optional): one, written ``[*B, T, 1]`` in nats, and under ``"next"`` too. Defaults
            to ``["prior_log_prob"]``.
        done_key, terminated_key (NestedKey): bool, ``[*B, T, 1]``, read under ``"next"``. Defaults to ``"done"`` and
            ``"terminated"``.
        traj_key (NestedKey): trajectory ids ``[*B, T]``, used if they are there. Defaults to
            ``("collector", "traj_ids")``.
        mask_key (NestedKey): bool ``[*B, T]``, false at the padding of split trajectories, used if it is there.
            What is written there is 0. Defaults to ``("collector", "mask")``.

    Raises:
        ValueError: ``boundary`` needs an actor; the batch has no time dimension; the prior is over
            other actions; the transform is put into an environment.
        KeyError: an entry is missing in the batch.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_priors.priors import BoltzmannPrior
        >>> prior = BoltzmannPrior(torch.tensor([[0.0, 1.0], [2.0, 0.0]]))
        >>> batch = TensorDict(
        ...     state=torch.tensor([0, 1, 0]),
        ...     action=torch.tensor([1, 0, 1]),
        ...     next=TensorDict(
        ...         state=torch.tensor([1, 0, 1]),
        ...         done=torch.tensor([[False], [True], [False]]),
        ...         terminated=torch.tensor([[False], [True], [False]]),
        ...     ),
        ...     batch_size=[3],
        ...     names=["time"],
        ... )
        >>> batch = PriorLogProb(prior, boundary="zero")(batch)
        >>> batch["prior_log_prob"].squeeze(-1)
        tensor([-0.3133, -0.1269, -0.3133])
        >>> batch["next", "prior_log_prob"].squeeze(-1)  # of the second step, terminated, the end of the batch
        tensor([-0.1269,  0.0000,  0.0000])
    """

    def __init__(
        self,
        prior: Prior,
        actor: TensorDictModuleBase | None = None,
        *,
        time_dim: int | None = None,
        boundary: Literal["expected", "sample", "zero"] = "expected",
        keep_params: bool = False,
        num_samples: int | None = None,
        out_keys: list[NestedKey] | None = None,
        done_key: NestedKey = "done",
        terminated_key: NestedKey = "terminated",
        traj_key: NestedKey = ("collector", "traj_ids"),
        mask_key: NestedKey = ("collector", "mask"),
    ) -> None:
        if not isinstance(prior, Prior):
            raise TypeError(f"The prior must be a Prior, got {type(prior).__name__}: try ActionPrior(policy).")
        check_option("boundary", boundary, ("expected", "sample", "zero"))
        if actor is None and boundary != "zero":
            raise ValueError(f"boundary={boundary!r} needs the student: pass actor, or boundary='zero'.")
        out_keys = ["prior_log_prob"] if out_keys is None else out_keys
        if len(out_keys) != 1:
            raise ValueError(f"Expected one key for the log-probability, got {out_keys}.")
        super().__init__(in_keys=[*prior.in_keys, prior.action_key], out_keys=out_keys)
        self.prior = prior
        self.register_load_state_dict_pre_hook(warn_of_another_teacher)
        self.__dict__["actor"] = actor
        self.time_dim = time_dim
        self.boundary = boundary
        self.keep_params = keep_params
        self.num_samples = num_samples
        self.done_key = under_next(done_key)
        self.terminated_key = under_next(terminated_key)
        self.traj_key = unravel_key(traj_key)
        self.mask_key = unravel_key(mask_key)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the entries into a batch ``[*B, T]`` and returns it."""
        time_dim = self._find_time_dim(tensordict)
        mask = tensordict.get(self.mask_key, None)
        mask = None if mask is None else mask.reshape(*tensordict.batch_size, 1)
        terminated, has_next, wanted = self._boundaries(tensordict, mask, time_dim)
        if not torch.compiler.is_compiling():
            self._warn_of_another_order(tensordict, has_next, time_dim)
        self._draw(tensordict, has_next, time_dim)

        actor: TensorDictModuleBase | None = self.__dict__["actor"]
        keys = dict.fromkeys([*self.prior.in_keys, *self.prior.draw_keys, *([] if actor is None else actor.in_keys)])
        steps = tensordict
        if mask is not None:
            used = (*keys, *map(under_next, keys), self.prior.action_key)
            steps = without_padding(tensordict, used, mask.squeeze(-1))
        params = self.prior.get_params(steps)
        dist = self.prior.build_dist(params)
        if self.keep_params:
            for key, name in zip(self.prior.out_keys, self.prior.param_names, strict=True):
                tensordict.set(key, params[name])
        value = self.prior.log_prob(steps, dist=dist).unsqueeze(-1)
        check_advice(value, dist)
        value = value if mask is None else value.masked_fill(~mask, 0.0)

        at_boundary = torch.zeros_like(value)
        # only the time steps at which some trajectory was cut; all where code is compiled, which looks at no data
        times = torch.arange(value.shape[time_dim], device=value.device)
        if not torch.compiler.is_compiling():
            times = times[wanted.movedim(time_dim, 0).flatten(1).any(-1)]
        if self.boundary != "zero" and len(times):
            cut = (slice(None),) * time_dim + (times,)
            part = steps.select(*keys, *map(under_next, keys), strict=False)[cut]
            following = next_step(part, keys, terminated[cut], read(tensordict, self.done_key, "")[cut])
            at_boundary.index_copy_(time_dim, times, self._evaluate_boundary(following).to(value.dtype))
            at_boundary = at_boundary if mask is None else at_boundary.masked_fill(~mask, 0.0)

        (key,) = self.out_keys
        shifted = shift_to_next(value, at_boundary, has_next, terminated, time_dim=time_dim)
        return tensordict.set(key, value).set(under_next(key), shifted)

    def _find_time_dim(self, tensordict: TensorDictBase) -> int:
        """The time dimension, given or named: one that is guessed wrong would shift over the batch."""
        shape = tuple(tensordict.batch_size)
        if self.time_dim is not None:
            if not -len(shape) <= self.time_dim < len(shape):
                raise ValueError(f"time_dim={self.time_dim} is not a dimension of the batch {shape}.")
            return self.time_dim % len(shape)
        names = list(tensordict.names)
        if "time" not in names:
            raise ValueError(
                f"The batch {shape} has no dimension named 'time' (its names are {names}): pass time_dim=..., or name"
                " it, e.g. batch.names = [None, 'time']."
            )
        return names.index("time")

    def _boundaries(
        self, tensordict: TensorDictBase, mask: Tensor | None, time_dim: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Where an episode terminates, where a step has a next action, and where the boundary's value is wanted."""
        hint = "PriorLogProb reads where trajectories end"
        terminated, done = (read(tensordict, key, hint) for key in (self.terminated_key, self.done_key))
        expected = (*tensordict.batch_size, 1)
        for key, flag in ((self.terminated_key, terminated), (self.done_key, done)):
            if flag.shape != expected:
                raise ValueError(f"Expected {key!r} of shape {tuple(expected)}, got {tuple(flag.shape)}.")
        traj_ids = tensordict.get(self.traj_key, None)
        has_next = has_next_action(done, None if traj_ids is None else traj_ids.reshape(expected), time_dim=time_dim)
        wanted = ~terminated
        if mask is not None:
            has_next = has_next & shift_to_next(mask, False, has_next, terminated, time_dim=time_dim)
            wanted = wanted & mask
        return terminated, has_next, wanted & ~has_next

    def _warn_of_another_order(self, tensordict: TensorDictBase, has_next: Tensor, time_dim: int) -> None:
        """A batch that was permuted keeps the name of its time dimension: what follows is then not the next step."""
        follows = has_next.squeeze(-1)
        for key in self.prior.in_keys:
            here, after = tensordict.get(key, None), tensordict.get(under_next(key), None)
            if here is None or after is None or here.shape != after.shape or not follows.any():
                continue
            same = here.roll(-1, time_dim) == after
            if same.ndim > follows.ndim:
                same = same.flatten(follows.ndim).all(-1)
            if not same[follows].any():
                warnings.warn(
                    f"No step of the batch goes on where its next one begins: {key!r} of step t + 1 is never"
                    f" {under_next(key)!r} of step t along dimension {time_dim}. Was it permuted? Run PriorLogProb"
                    " before a rollout is flattened, shuffled or augmented.",
                    stacklevel=4,
                )
            return

    def _draw(self, tensordict: TensorDictBase, has_next: Tensor, time_dim: int) -> None:
        """Lets the prior draw, the same for the next state of step t and for the state of step t + 1."""
        if not self.prior.draw_keys:
            return
        following = tensordict.get("next")
        self.prior.draw(tensordict)
        self.prior.draw(following)
        for key in self.prior.draw_keys:
            draw = shift_to_next(
                tensordict.get(key), following.get(key), has_next, torch.zeros_like(has_next), time_dim=time_dim
            )
            tensordict.set(under_next(key), draw)

    def _evaluate_boundary(self, following: TensorDictBase) -> Tensor:
        """What next states whose action was not sampled are worth, ``[*B, steps, 1]``."""
        actor: TensorDictModuleBase = self.__dict__["actor"]
        prior_dist, policy = self.prior.get_dist(following), actor.get_dist(following.copy())  # it writes its own
        if self.boundary == "expected":
            log_prob = -cross_entropy(policy, prior_dist, num_samples=self.num_samples)
        else:
            log_prob = prior_dist.log_prob(policy.sample())
        check_advice(log_prob, prior_dist, policy)
        return joint(log_prob, following.ndim)
