"""Who learns in a MuJoCo run: one student, or, with ``method=trial``, several that compete until one is chosen."""

from __future__ import annotations

from collections.abc import Iterator
from statistics import NormalDist
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from recipes.mujoco.agent import Student
from recipes.mujoco.config import ALONE, MujocoConfig, sources
from recipes.mujoco.task import Task
from torchrl_priors.episode_returns import welch
from torchrl_priors.teacher_trial import TeacherTrial, TrialResult

__all__ = ["LET_GO", "Students", "arms"]

LET_GO = ", let go"


def arms(cfg: MujocoConfig) -> dict[str, MujocoConfig]:
    """The configuration of each student, by the name of its teacher; of a run without a trial, the only one."""
    if cfg.method != "trial":
        return {cfg.method: cfg}
    alone = {ALONE: {"method": "none", "prior": {"path": None}}}
    taught: Any = {"method": cfg.trial.method}
    if cfg.let_go.methods == "trial":
        taught["let_go"] = {"methods": "all"}
    each = {source.name: taught | {"prior": {"path": source.text}} for source in sources(cfg)}
    return {
        arm: cast("MujocoConfig", OmegaConf.merge(cast("DictConfig", cfg), changed))
        for arm, changed in (alone | each).items()
    }


class Students:
    """The students of a run, who take turns, and the trial between them while there is one.

    With ``method=trial`` the first trial is between the teachers. When the returns of a student with a teacher do not
    rise any more, a second one finds out whether it is better off without: a twin, whose teacher fades, against the
    student itself. If the teacher stays, the next such trial comes when the student has made twice as many frames, and
    may take twice as long: gains without a teacher are slow to show. The student with the teacher is kept where it
    was. It goes on in the place of one that let go and fell clearly behind the returns that it had then.
    """

    def __init__(self, cfg: MujocoConfig, task: Task) -> None:
        self.cfg = cfg
        self.by_arm = {arm: Student(arm_cfg, task) for arm, arm_cfg in arms(cfg).items()}
        self.chosen = next(iter(self.by_arm))
        """Whose policy is the run's: the last winner's; before there is one, that of the student alone."""
        self.results: list[TrialResult] = []
        self._patience, self._tried = 0, 0
        self.trial = self._trial(list(self.by_arm)) if len(self.by_arm) > 1 else None
        self.frames = 0
        """Of all students together."""

    def _trial(self, arms: list[str]) -> TeacherTrial:
        """In doubt about teachers the student alone goes on; about letting go, who has the higher returns."""
        trial = self.cfg.trial
        options: dict[str, Any] = {"alpha": trial.alpha, "recent": trial.recent, "min_frames": trial.min_frames}
        options["in_doubt"] = "first" if arms[0] == ALONE else "best"
        return TeacherTrial(arms, max_frames=trial.max_frames * 2 ** max(self._tried - 1, 0), **options)

    def round(self) -> Iterator[tuple[str, dict[str, Tensor], Tensor | None]]:
        """Train each student that is still in on one rollout; its name, what was measured, and the prior weights.

        After the last of them a trial may end or begin.
        """
        for arm in [self.chosen] if self.trial is None else list(self.trial.active):
            if self.frames >= self.cfg.total_frames:  # in the middle of a trial
                return
            rollout, metrics, weights = self.by_arm[arm].round()
            self.frames += rollout.numel()
            if self.trial is not None:
                self.trial.update(arm, rollout)
            yield arm, metrics, weights
        if self.trial is not None:
            if (result := self.trial.decide()) is not None:
                self.results.append(result)
                self.chosen, self.trial = result.winner, None
        elif (result := self._fallen()) is not None:
            self.results.append(result)
            del self.by_arm[self.chosen]
            self.chosen = result.winner
        elif self._may_let_go():
            student = self.by_arm[self.chosen]
            twin = student.twin()
            twin.leaving = student.collector.frames
            self._patience, self._tried = 2 * student.collector.frames, self._tried + 1
            self.by_arm[self.chosen + LET_GO] = twin
            self.trial = self._trial([self.chosen, self.chosen + LET_GO])

    def _fallen(self) -> TrialResult | None:
        """That a student without its teacher is clearly behind the one who is kept, if it is so."""
        student, kept = self.by_arm[self.chosen], self.by_arm.get(self.chosen.removesuffix(LET_GO))
        if kept is None or kept is student or student.plateau is None or kept.plateau is None:
            return None
        before, now = (plateau.within(plateau.window) for plateau in (kept.plateau, student.plateau))
        if min(len(before), len(now)) < kept.plateau.min_episodes:
            return None
        fall, error = welch(before, now)
        if fall <= max(self.cfg.let_go.fall * error, kept.plateau.gain * abs(float(before.mean()))):
            return None
        arms = {self.chosen.removesuffix(LET_GO): kept, self.chosen: student}
        frames = {arm: each.collector.frames for arm, each in arms.items()}
        returns = dict(zip(arms, (float(before.mean()), float(now.mean())), strict=True))
        return TrialResult(next(iter(arms)), fall, NormalDist().cdf(self.cfg.let_go.fall), frames, returns)

    def _may_let_go(self) -> bool:
        """Whether the student's returns stand still, it is time to look, and a trial can still be decided."""
        student = self.by_arm[self.chosen]
        if student.plateau is None or student.leaving is not None or student.collector.frames < self._patience:
            return False
        enough = self.frames + 2 * self.cfg.trial.min_frames <= self.cfg.total_frames
        return enough and student.plateau.reached

    @property
    def several(self) -> bool:
        """Whether there is, or may be, more than one."""
        return len(self.by_arm) > 1 or any(student.plateau is not None for student in self.by_arm.values())

    def parts(self) -> dict[str, Any]:
        """What a checkpoint consists of, by name; ``stage`` is to be loaded first, for it says who there is."""
        found: dict[str, Any] = {"stage": self}
        for number, student in enumerate(self.by_arm.values()):
            suffix = f"_{number}" if number else ""
            found |= {f"{name}{suffix}": part for name, part in student.parts().items()}
        return found

    def state_dict(self) -> dict[str, Any]:
        """Where the run is, as plain values; the students are parts of their own."""
        return {
            "chosen": self.chosen,
            "frames": self.frames,
            "patience": self._patience,
            "tried": self._tried,
            "leaving": {arm: student.leaving for arm, student in self.by_arm.items()},
            "results": [result._asdict() for result in self.results],
            "trial": None if self.trial is None else self.trial.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue where a run was."""
        self.chosen, self.frames = state_dict["chosen"], int(state_dict["frames"])
        self.results = [TrialResult(**result) for result in state_dict["results"]]
        for arm, leaving in state_dict["leaving"].items():
            if arm not in self.by_arm:
                kept = self.by_arm[arm.removesuffix(LET_GO)]
                self.by_arm[arm] = Student(kept.cfg, kept.task)
            self.by_arm[arm].leaving = leaving
        self._patience, self._tried = int(state_dict["patience"]), int(state_dict["tried"])
        self.trial = None
        if (trial := state_dict["trial"]) is not None:
            self.trial = self._trial([arm for arm in self.by_arm if arm in trial["returns"]])
            self.trial.load_state_dict(trial)
