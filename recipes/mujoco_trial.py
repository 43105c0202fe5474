"""Who learns in a MuJoCo run: one student, or, with ``method=trial``, several that compete until one is chosen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from recipes.mujoco_agent import Student
from recipes.mujoco_config import ALONE, MujocoConfig, teachers
from torchrl_priors.teacher_trial import TeacherTrial, TrialResult

__all__ = ["Students", "arms"]


def arms(cfg: MujocoConfig) -> dict[str, MujocoConfig]:
    """The configuration of each student, by the name of its teacher; of a run without a trial, the only one."""
    if cfg.method != "trial":
        return {cfg.method: cfg}
    alone = {ALONE: {"method": "none", "prior": {"path": None}}}
    taught: Any = {"method": cfg.trial.method}
    if cfg.let_go.methods == "trial":
        taught["let_go"] = {"methods": "all"}
    each = {file.stem: taught | {"prior": {"path": str(file)}} for file in teachers(cfg)}
    return {
        arm: cast("MujocoConfig", OmegaConf.merge(cast("DictConfig", cfg), changed))
        for arm, changed in (alone | each).items()
    }


class Students:
    """The students of a run, who take turns, and the trial between them if there is one."""

    def __init__(self, cfg: MujocoConfig, env_id: str) -> None:
        self.by_arm = {arm: Student(arm_cfg, env_id) for arm, arm_cfg in arms(cfg).items()}
        self.trial: TeacherTrial | None = None
        if cfg.method == "trial":
            options = cfg.trial
            self.trial = TeacherTrial(
                list(self.by_arm),
                max_frames=options.max_frames,
                min_frames=options.min_frames,
                alpha=options.alpha,
                recent=options.recent,
            )

    @property
    def frames(self) -> int:
        """Of all students together."""
        return sum(student.collector.frames for student in self.by_arm.values())

    @property
    def result(self) -> TrialResult | None:
        """Of the trial."""
        return None if self.trial is None else self.trial.result

    @property
    def chosen(self) -> str:
        """Whose policy is the run's: the winner's; before there is one, that of the student alone."""
        return next(iter(self.by_arm)) if self.result is None else self.result.winner

    def parts(self) -> dict[str, Any]:
        """What a checkpoint consists of, by name."""
        several: dict[str, Any] = {} if self.trial is None else {"trial": self.trial}
        for number, student in enumerate(self.by_arm.values()):
            suffix = "" if self.trial is None else f"_{number}"
            several |= {f"{name}{suffix}": part for name, part in student.parts().items()}
        return several

    def round(self) -> Iterator[tuple[str, dict[str, Tensor], Tensor | None]]:
        """Train each student that is still in on one rollout; its name, what was measured, and the prior weights.

        The trial is decided after the last of them, if it can be.
        """
        if self.trial is None or self.trial.result is not None:
            _, metrics, weights = self.by_arm[self.chosen].round()
            yield self.chosen, metrics, weights
            return
        for arm in list(self.trial.active):
            rollout, metrics, weights = self.by_arm[arm].round()
            self.trial.update(arm, rollout)
            yield arm, metrics, weights
        self.trial.decide()
