"""PPO with an AVEC critic on MuJoCo, learning from a teacher by any of the methods.

    python -m recipes.mujoco env=hopper method=ae2r prior.path=teacher.safetensors [key=value ...]

A run keeps everything in one folder: ``eval.csv``, ``metrics.csv``, checkpoints and, at the end, the teacher that it
makes, ``policy.safetensors``. An interrupted run continues with the same command; a finished one is not run again. See
``conf/mujoco.yaml`` for the keys.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import hydra
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from recipes.mujoco_config import MujocoConfig, check
from recipes.mujoco_run import Run, supervise
from recipes.schedule_config import applies, make_schedule
from torchrl_priors import (
    ActionPrior,
    AVECMixin,
    ClipPPOPriorLoss,
    CoeffScheduler,
    PriorBonus,
    PriorLogProb,
    PriorTrust,
    RandomDegradation,
    StructuralDegradation,
    ValueOffset,
    advice_evidence,
    get_method,
)
from torchrl_priors.artifacts import load_prior
from torchrl_priors.collectors import RunningNorm, VectorCollector, evaluate, make_vector_env
from torchrl_priors.networks import make_actor, make_critic, make_prior_weight
from torchrl_priors.objectives import CompiledStep


class AVECClipPPOLoss(AVECMixin, ClipPPOLoss):
    """PPO whose critic minimises the variance of its residual."""


class AVECClipPPOPriorLoss(AVECMixin, ClipPPOPriorLoss):
    """The same with a prior."""


def make_prior(cfg: MujocoConfig, env_id: str, obs_dim: int, act_dim: int) -> ActionPrior:
    """The teacher, degraded as the configuration says."""
    assert cfg.prior.path is not None
    prior: ActionPrior = load_prior(cfg.prior.path, env_id=env_id, observation_spec=obs_dim, action_spec=act_dim)
    if cfg.prior.degrade == "structural":
        feature, threshold = cfg.prior.feature, cfg.prior.threshold
        return StructuralDegradation(prior, lambda td: td["observation"][..., feature] > threshold)
    if cfg.prior.degrade == "random":
        return RandomDegradation(prior, cfg.prior.prob, seed=cfg.seed)
    return prior


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
    if cfg.weight.trained == "trust":
        listen, min_trust = cfg.weight.listen, cfg.weight.min_trust
        return PriorTrust(obs_dim, listen=listen, min_trust=min_trust, in_keys=["observation_norm"])
    return make_prior_weight(obs_dim, list(cfg.ppo.hidden), init_bias=cfg.weight.init_bias)


class Agent(nn.Module):
    """The networks of a run, its loss, and how a rollout is prepared for it."""

    def __init__(self, cfg: MujocoConfig, env_id: str, obs_dim: int, act_dim: int) -> None:
        super().__init__()
        spec = get_method(cfg.method)
        hidden = list(cfg.ppo.hidden)
        self.spec, self.cfg = spec, cfg
        self.normalizer = RunningNorm(obs_dim)
        self.actor = make_actor(obs_dim, act_dim, hidden)
        self.critic = make_critic(obs_dim, hidden)
        self.critic.module = nn.Sequential(self.critic.module, ValueOffset())
        options: dict[str, Any] = {"centering": cfg.centering, "bonus_coeff": cfg.bonus_coeff, "td_error": cfg.td_error}
        ppo: dict[str, Any] = {
            "clip_epsilon": cfg.ppo.clip_epsilon,
            "entropy_bonus": True,
            "entropy_coeff": cfg.ppo.entropy_coeff,
            "critic_coeff": 1.0,
            "normalize_advantage": True,
            "functional": False,
            "log_explained_variance": False,
        }
        self.advantage = GAE(gamma=cfg.ppo.gamma, lmbda=cfg.ppo.gae_lambda, value_network=self.critic)
        self.transforms: list[Any] = []
        self.weight, self.raw_critic = None, None
        if cfg.method == "none":
            self.loss: nn.Module = AVECClipPPOLoss(self.actor, self.critic, **ppo)
            return
        prior = make_prior(cfg, env_id, obs_dim, act_dim)
        if spec.adaptive:
            self.weight = make_weight(cfg, obs_dim)
            if not [*self.weight.parameters()]:
                options["weight_target"] = "none"
            elif cfg.td_error == "original" and spec.weight_target == "td":
                self.raw_critic = make_critic(obs_dim, hidden)
        self.transforms.append(PriorLogProb(prior, self.actor, keep_params=True, centering=options["centering"]))
        if spec.bonus != "none":
            bonus = PriorBonus.from_method(
                cfg.method, self.weight, centering=cfg.centering, bonus_coeff=cfg.bonus_coeff
            )
            self.transforms.append(bonus)
            self.advantage.set_keys(reward="shaped_reward")
        self.loss = AVECClipPPOPriorLoss(
            self.actor,
            self.critic,
            prior,
            self.weight,
            self.raw_critic,
            method=cfg.method,
            aux_coeff=cfg.aux_coeff,
            gamma=cfg.ppo.gamma,
            prior_in_batch=True,
            **options,
            **ppo,
        )
        if spec.weight_target == "advantage" and spec.bonus == "none":
            # without a bonus PPO's own advantage is one on raw rewards
            self.loss.set_keys(raw_advantage="advantage")

    def networks(self) -> dict[str, nn.Module]:
        """What is trained, by name."""
        networks = {"actor": self.actor, "critic": self.critic, "weight": self.weight, "raw_critic": self.raw_critic}
        return {name: network for name, network in networks.items() if network is not None and [*network.parameters()]}

    def schedulers(self) -> dict[str, CoeffScheduler]:
        """What anneals the method's coefficients, by name; nothing where they are constant."""
        cfg = self.cfg
        if not applies(cfg.schedule, cfg.method):
            return {}
        prior_loss: Any = self.loss.prior_loss
        coefficients: dict[str, tuple[nn.Module, str]] = {}
        if self.spec.auxiliary:
            coefficients["aux_coeff"] = (prior_loss, "aux_coeff")
        if self.spec.bonus != "none":  # of the transform, and of the prior weight's loss
            coefficients["bonus_coeff"] = (self.transforms[-1], "bonus_coeff")
            coefficients["loss_bonus_coeff"] = (prior_loss, "bonus_coeff")
        return {
            name: CoeffScheduler(
                module, buffer, make_schedule(cfg.schedule, cfg.total_frames, float(module.get_buffer(buffer)))
            )
            for name, (module, buffer) in coefficients.items()
        }

    @torch.no_grad()
    def prepare(self, rollout: TensorDictBase) -> TensorDictBase:
        """Score the rollout under the prior, shape its rewards, estimate advantages: once, for all epochs."""
        for transform in self.transforms:
            rollout = transform(rollout)
        rollout = self.advantage(rollout)
        if isinstance(self.weight, PriorTrust) and not self.weight.decided:
            # until it has decided there is no bonus either, so that this is an advantage on raw rewards
            prior = self.transforms[0].prior
            dist, prior_dist = self.actor.get_dist(rollout.copy()), prior.get_dist(rollout.copy())
            evidence = advice_evidence(rollout["advantage"], rollout["prior_log_prob"], dist, prior_dist)
            self.weight.update(rollout["observation_norm"], evidence)
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


def train(cfg: MujocoConfig, run: Run) -> None:
    """Train to the end, from the last checkpoint if there is one."""
    torch.manual_seed(cfg.seed)
    env_id = f"{cfg.env.id}-{cfg.env.version}"
    env = make_vector_env(env_id, cfg.env.num_envs, **cfg.env.kwargs)
    test_env = make_vector_env(env_id, cfg.evaluation.episodes, **cfg.env.kwargs)
    agent = Agent(cfg, env_id, env.single_observation_space.shape[0], env.single_action_space.shape[0])
    optimise = Optimiser(agent)
    collector = VectorCollector(
        env,
        agent.actor,
        frames_per_batch=cfg.env.frames_per_batch,
        total_frames=cfg.total_frames,
        normalizer=agent.normalizer,
        seed=cfg.seed,
    )
    schedulers = agent.schedulers()
    run.register(agent=agent, optimizer=optimise.adam, collector=collector)
    for scheduler in schedulers.values():
        scheduler.step(collector.frames)

    def evaluate_policy() -> None:
        result = evaluate(
            test_env,
            agent.actor,
            episodes=cfg.evaluation.episodes,
            normalizer=agent.normalizer,
            seed=cfg.seed * 1_000_003 + collector.frames,
        )
        run.log_evaluation(collector.frames, result)

    if collector.frames == 0:
        evaluate_policy()
    if cfg.compile:
        run.announce("compiling")
    start, first = time.perf_counter(), collector.frames
    for rollout in collector:
        metrics = optimise(agent.prepare(rollout))
        ended = rollout["next", "done"].squeeze(-1)
        metrics["episode_return"] = rollout["next", "episode_reward"].squeeze(-1)[ended].mean()
        metrics["fps"] = torch.tensor((collector.frames - first) / (time.perf_counter() - start))
        weight = None
        if agent.weight is not None:
            weight = agent.weight(rollout.select(*agent.weight.in_keys))["prior_weight"].detach()
            for quantile in (5, 50, 95):
                metrics[f"prior_weight_q{quantile:02d}"] = weight.quantile(quantile / 100)
        if isinstance(agent.weight, PriorTrust):
            metrics["prior_trust"] = agent.weight.mean_trust.nan_to_num(0.0)  # before it decides
        metrics |= {name: torch.tensor(scheduler.value) for name, scheduler in schedulers.items()}
        run.log(collector.frames, metrics, weight)
        for scheduler in schedulers.values():
            scheduler.step(collector.frames)
        if run.evaluation_is_due(collector.frames):
            evaluate_policy()
        run.checkpoint_if_due(collector.frames)
    run.finish(agent.actor, agent.normalizer, env_id)


@hydra.main(version_base="1.3", config_path="../conf", config_name="mujoco")
def main(cfg: MujocoConfig) -> str | None:
    """Train, or continue training, one agent."""
    return supervise(cfg, check, train)


if __name__ == "__main__":
    main()
