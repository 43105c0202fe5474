"""One learner of a MuJoCo run: its teacher, its networks and loss, the epochs on a rollout, the student around them."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from recipes.common.schedules import applies, make_schedule
from recipes.mujoco.config import MujocoConfig, method_of, sources
from recipes.mujoco.task import Task
from recipes.mujoco.teachers import ReversedPrior
from torchrl_priors import (
    AE2RLoss,
    AVECMixin,
    ClipPPOPriorLoss,
    Prior,
    PriorBonus,
    PriorLogProb,
    RandomDegradation,
    StructuralDegradation,
    ValueOffset,
)
from torchrl_priors.collectors import RunningNorm, VectorCollector
from torchrl_priors.episode_returns import Plateau
from torchrl_priors.networks import make_actor, make_critic, make_prior_weight
from torchrl_priors.objectives import CompiledStep
from torchrl_priors.schedules import CoeffScheduler


class AVECClipPPOLoss(AVECMixin, ClipPPOLoss):
    """PPO whose critic minimises the variance of its residual."""


class AVECClipPPOPriorLoss(AVECMixin, ClipPPOPriorLoss):
    """The same with a prior."""


def make_prior(cfg: MujocoConfig, task: Task) -> Prior:
    """The teacher, degraded as the configuration says."""
    (prior,) = (task.teachers[source.text] for source in sources(cfg))
    if cfg.prior.degrade == "structural":
        feature, threshold = cfg.prior.feature, cfg.prior.threshold
        return StructuralDegradation(prior, lambda td: td["observation"][..., feature] > threshold)
    if cfg.prior.degrade == "random":
        return RandomDegradation(prior, cfg.prior.prob, seed=cfg.seed)
    return ReversedPrior(prior, task.actions) if cfg.prior.degrade == "reversed" else prior


class OracleWeight(nn.Module):
    """The prior weight of one who knows: 1 where a structurally degraded teacher is right, 0 where it is not."""

    def __init__(self, feature: int, threshold: float) -> None:
        super().__init__()
        self.feature, self.threshold = feature, threshold

    def forward(self, observation: Tensor) -> Tensor:
        """``[*B, obs_dim]`` to ``[*B, 1]``."""
        return (observation[..., self.feature, None] <= self.threshold).to(observation.dtype)


def make_weight(cfg: MujocoConfig, obs_dim: int) -> TensorDictModuleBase:
    """The prior weight. One without parameters draws no random numbers: where it is 0 the run is that of PPO."""
    if cfg.weight.trained == "oracle":
        oracle = OracleWeight(cfg.prior.feature, cfg.prior.threshold)
        return TensorDictModule(oracle, in_keys=["observation"], out_keys=["prior_weight"])
    return make_prior_weight(obs_dim, list(cfg.ppo.hidden), init_bias=cfg.weight.init_bias)


def lets_go(cfg: MujocoConfig) -> bool:
    """Whether it is tried to let the student's teacher go."""
    return cfg.method != "none" and cfg.let_go.methods == "all" and not applies(cfg.schedule, cfg.method)


class Agent(nn.Module):
    """The networks of a run, its loss, and how a rollout is prepared for it."""

    def __init__(self, cfg: MujocoConfig, task: Task) -> None:
        super().__init__()
        spec, obs_dim = method_of(cfg), task.obs_dim
        hidden = list(cfg.ppo.hidden)
        self.spec, self.cfg = spec, cfg
        self.normalizer = RunningNorm(obs_dim)
        self.actor = make_actor(obs_dim, task.act_dim, hidden, discrete=task.discrete)
        self.critic = make_critic(obs_dim, hidden)
        self.critic.module = nn.Sequential(self.critic.module, ValueOffset())
        options: dict[str, Any] = {"bonus_coeff": cfg.bonus_coeff, "td_error": cfg.td_error, "functional": False}
        ppo: dict[str, Any] = {
            "clip_epsilon": cfg.ppo.clip_epsilon,
            "entropy_bonus": True,
            "entropy_coeff": cfg.ppo.entropy_coeff,
            "critic_coeff": 1.0,
            "normalize_advantage": True,
            "log_explained_variance": False,
        }
        self.advantage = GAE(gamma=cfg.ppo.gamma, lmbda=cfg.ppo.gae_lambda, value_network=self.critic)
        self.transforms: list[Any] = []
        self.weight, self.raw_critic, self.shares_entropy = None, None, False
        if cfg.method == "none":
            self.loss: nn.Module = AVECClipPPOLoss(self.actor, self.critic, functional=False, **ppo)
            return
        prior = make_prior(cfg, task)
        if spec.adaptive:
            self.weight = make_weight(cfg, obs_dim)
            if not [*self.weight.parameters()]:
                options["weight_target"] = "none"
            elif cfg.td_error == "original" and spec.weight_target == "td":
                self.raw_critic = make_critic(obs_dim, hidden)
        self.transforms.append(PriorLogProb(prior, self.actor, keep_params=True))
        if spec.bonus != "none":
            self.transforms.append(PriorBonus.from_method(cfg.method, self.weight, bonus_coeff=cfg.bonus_coeff))
            self.advantage.set_keys(reward="shaped_reward")
        self.shares_entropy = lets_go(cfg) and spec.auxiliary and spec.cross_entropy == "student"
        if self.shares_entropy:
            options["kl_share"] = 0.0
        prior_loss = AE2RLoss(
            self.actor,
            prior,
            self.weight,
            self.critic if cfg.td_error == "shaped" else self.raw_critic,
            method=spec,
            aux_coeff=cfg.aux_coeff,
            gamma=cfg.ppo.gamma,
            prior_in_batch=True,
            **options,
        )
        if spec.weight_target == "advantage" and spec.bonus == "none":
            # without a bonus PPO's own advantage is one on raw rewards
            prior_loss.set_keys(raw_advantage="advantage")
        self.loss = AVECClipPPOPriorLoss(self.actor, self.critic, prior_loss, **ppo)

    def networks(self) -> dict[str, nn.Module]:
        """What is trained, by name."""
        networks = {"actor": self.actor, "critic": self.critic, "weight": self.weight, "raw_critic": self.raw_critic}
        return {name: network for name, network in networks.items() if network is not None and [*network.parameters()]}

    def coefficients(self) -> dict[str, tuple[nn.Module, str]]:
        """Those of the method, by name: the module and its buffer."""
        found: dict[str, tuple[nn.Module, str]] = {}
        prior_loss: Any = getattr(self.loss, "prior_loss", None)
        if self.spec.auxiliary:
            found["aux_coeff"] = (prior_loss, "aux_coeff")
        if self.spec.bonus != "none":  # of the transform, and of the prior weight's loss
            found["bonus_coeff"] = (self.transforms[-1], "bonus_coeff")
            found["loss_bonus_coeff"] = (prior_loss, "bonus_coeff")
        return found

    @torch.no_grad()
    def prepare(self, rollout: TensorDictBase) -> TensorDictBase:
        """Score the rollout under the prior, shape its rewards, estimate advantages: once, for all epochs."""
        for transform in self.transforms:
            rollout = transform(rollout)
        rollout = self.advantage(rollout)
        # Fewer entries make for faster minibatches.
        keys: Any = self.loss.in_keys
        read = [*keys, "advantage", "value_target", ("next", "prior_bonus")]
        return rollout.select(*read, strict=False)


class Optimiser:
    """The epochs on a rollout."""

    def __init__(self, agent: Agent) -> None:
        cfg = agent.cfg
        rate = {"weight": cfg.ppo.lr * cfg.weight.lr_coeff}
        # a group for each network: its gradient is clipped apart
        groups = [
            {"params": list(network.parameters()), "lr": rate.get(name, cfg.ppo.lr)}
            for name, network in agent.networks().items()
        ]
        self.agent = agent
        self.adam = torch.optim.Adam(groups, lr=cfg.ppo.lr, eps=cfg.ppo.adam_eps, fused=True)
        options: dict[str, Any] = {
            "max_grad_norm": cfg.ppo.max_grad_norm,
            "backend": "inductor" if cfg.compile else "eager",
        }
        later = {"loss_prior_weight"} if cfg.weight.trained == "rollout" else set()
        self.step = CompiledStep(
            agent.loss, self.adam, select=lambda name: name.startswith("loss_") and name not in later, **options
        )
        self.weight_step = CompiledStep(agent.loss, self.adam, select=later.__contains__, **options) if later else None

    def __call__(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Train on a prepared rollout; the mean of everything that the loss reports."""
        cfg, batch = self.agent.cfg, rollout.reshape(-1)
        report = self.step(batch, minibatches(len(batch), cfg.env.minibatch_size, cfg.ppo.epochs)).mean(0)
        if self.weight_step is not None and self.agent.weight is not None:
            self.weight_step(batch, minibatches(len(batch), cfg.env.minibatch_size, cfg.weight.epochs))
        self.agent.loss.update_value_offset(batch)  # type: ignore[operator]
        return dict(zip(self.step.names, report, strict=True))


def minibatches(frames: int, size: int, epochs: int) -> Iterator[Tensor]:
    """The indices of random minibatches, every frame once per epoch."""
    for _ in range(epochs):
        yield from torch.randperm(frames).split(size)


class Student:
    """One learner: its agent, its optimiser, its environments, and random numbers of its own.

    Several can take turns in one process: what each does is what it would do alone.
    """

    def __init__(self, cfg: MujocoConfig, task: Task) -> None:
        torch.manual_seed(cfg.seed)
        self.agent = Agent(cfg, task)
        self.optimise = Optimiser(self.agent)
        self.collector = VectorCollector(
            task.make_env(cfg.env.num_envs),
            self.agent.actor,
            frames_per_batch=cfg.env.frames_per_batch,
            normalizer=self.agent.normalizer,
            seed=cfg.seed,
        )
        self.cfg, self.task = cfg, task
        self.coefficients = self.agent.coefficients()
        self.full = {name: float(module.get_buffer(buffer)) for name, (module, buffer) in self.coefficients.items()}
        self.schedulers: dict[str, CoeffScheduler] = {}
        if applies(cfg.schedule, cfg.method):
            for name, (module, buffer) in self.coefficients.items():
                schedule = make_schedule(cfg.schedule, cfg.total_frames, self.full[name])
                self.schedulers[name] = CoeffScheduler(module, buffer, schedule)
        self.plateau = Plateau(window=cfg.let_go.window) if lets_go(cfg) else None
        self.leaving: int | None = None
        """Its frames when its teacher began to fade."""
        self.random = RandomState()

    def parts(self) -> dict[str, Any]:
        """What a checkpoint has of it, by name."""
        parts: dict[str, Any] = {"agent": self.agent, "optimizer": self.optimise.adam, "collector": self.collector}
        parts["random"] = self.random
        return parts if self.plateau is None else parts | {"plateau": self.plateau}

    def twin(self) -> Student:
        """Another student in the same state."""
        twin = Student(self.cfg, self.task)
        for name, part in self.parts().items():
            twin.parts()[name].load_state_dict(deepcopy(part.state_dict()))
        twin.leaving = self.leaving
        return twin

    def _set_coefficients(self) -> None:
        for scheduler in self.schedulers.values():
            scheduler.step(self.collector.frames)
        if self.leaving is None:
            return
        factor = max(0.0, 1.0 - (self.collector.frames - self.leaving) / self.cfg.let_go.window)
        for name, (module, buffer) in self.coefficients.items():
            module.get_buffer(buffer).fill_(factor * self.full[name])
        if self.agent.shares_entropy:  # the student's entropy, which the cross-entropy took
            prior_loss: Any = self.agent.loss.prior_loss
            prior_loss.kl_share.fill_(1.0)

    def round(self) -> tuple[TensorDictBase, dict[str, Tensor], Tensor | None]:
        """Collect a rollout and train on it; the rollout, the means of what was measured, and its states' weights."""
        self.random.restore()
        self._set_coefficients()
        rollout = self.collector.rollout()
        metrics = self.optimise(self.agent.prepare(rollout))
        ended = rollout["next", "done"].squeeze(-1)
        metrics["episode_return"] = rollout["next", "episode_reward"].squeeze(-1)[ended].mean()
        if self.schedulers or self.leaving is not None:
            metrics |= {name: module.get_buffer(at).clone() for name, (module, at) in self.coefficients.items()}
        if self.plateau is not None:
            self.plateau.update(rollout)
        weights = None
        if (weight := self.agent.weight) is not None:
            weights = weight(rollout.select(*weight.in_keys))["prior_weight"].detach()
            metrics["prior_weight"] = weights.mean()
            metrics |= {f"prior_weight_q{part:02d}": weights.quantile(part / 100) for part in (5, 50, 95)}
        self.random.keep()
        return rollout, metrics, weights


class RandomState:
    """The state of torch's global generator, kept for one of several who take turns with it."""

    def __init__(self) -> None:
        self.keep()

    def keep(self) -> None:
        """Remember the state as it is now."""
        self.state = torch.get_rng_state()

    def restore(self) -> None:
        """Go on from what was remembered."""
        torch.set_rng_state(self.state)

    def state_dict(self) -> dict[str, Tensor]:
        """What was remembered."""
        return {"state": self.state}

    def load_state_dict(self, state_dict: dict[str, Tensor]) -> None:
        """Remember the state of another."""
        self.state = state_dict["state"].cpu()
