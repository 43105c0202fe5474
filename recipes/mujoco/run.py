"""The folder of a MuJoCo run: its tables, checkpoints and status, and what to do when it is broken off or fails."""

from __future__ import annotations

import json
import math
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from omegaconf import OmegaConf
from torch import Tensor
from tqdm import tqdm

from recipes.common.checkpoints import Checkpoints
from recipes.common.loggers import RunLogger
from recipes.common.preemption import Notice
from recipes.common.progress import progress_bar
from recipes.common.run_folder import RunFolder, digest, read_json
from recipes.common.schedules import without_idle
from recipes.common.sweeps import fail, in_sweep
from recipes.mujoco.config import MujocoConfig, env_id
from recipes.mujoco.teachers import identify
from torchrl_priors import policy_prior, save_prior
from torchrl_priors.collectors.evaluation import Evaluation
from torchrl_priors.teacher_trial import TrialResult

if TYPE_CHECKING:
    from recipes.mujoco.trial import Students

__all__ = ["Run", "Supervisor", "TrainingError", "identity"]

#: What the results do not depend on.
_INCIDENTAL = ("label", "out", "resume", "logger", "checkpoint")


class TrainingError(RuntimeError):
    """Training cannot go on; the last good checkpoint is kept."""


def identity(matters: dict[str, Any]) -> str:
    """What tells the checkpoints of a run from those of others: all that its results depend on, but for its length."""
    return digest({key: value for key, value in matters.items() if key != "total_frames"})


class Run:
    """A run's folder and schedule.

    ``eval.csv`` and ``metrics.csv`` are written whole with every evaluation and checkpoint. After an interruption the
    rows that are newer than the checkpoint are dropped: they come again.
    """

    def __init__(self, cfg: MujocoConfig) -> None:
        plain: Any = OmegaConf.to_container(cfg, resolve=True)
        matters = {key: value for key, value in plain.items() if key not in _INCIDENTAL}
        idle = [] if cfg.method == "trial" or cfg.let_go.methods == "all" else ["trial", "let_go"]
        matters = {key: value for key, value in matters.items() if key not in idle}
        matters = without_idle(matters, cfg.schedule, [cfg.trial.method if cfg.method == "trial" else cfg.method])
        matters["prior"] = identify(cfg, matters["prior"])
        path = Path(cfg.out or f"outputs/mujoco/{env_id(cfg)}/{cfg.method}-{digest(matters)}")
        self.cfg = cfg
        self.frames = 0
        self.is_to_stop = False
        # what a run did up to a number of frames does not depend on how many are to come, but for these
        longer = [] if "schedule" in matters or "let_go" in matters else ["total_frames"]
        self.folder = RunFolder(path, matters, OmegaConf.to_yaml(cfg, resolve=True), may_grow=longer)
        self.evaluations: list[dict[str, Any]] = []
        self.metrics: list[dict[str, Any]] = []
        self.checkpoints = Checkpoints(self.folder.path / "checkpoints", cfg.checkpoint.keep, identity(matters))

    @property
    def status(self) -> dict[str, Any]:
        """What is known of the run: its state (``running``, ``finished`` or ``failed``), frames, and error if any."""
        path = self.folder.path / "status.json"
        return read_json(path) if path.exists() else {"state": "new", "frames": 0}

    def set_status(self, state: str, **more: Any) -> None:
        """Write ``status.json``."""
        self.folder.write("status.json", json.dumps({"state": state, **more}))

    @property
    def is_finished(self) -> bool:
        """Whether there is nothing left to do."""
        status = self.status
        return self.cfg.resume and status.get("state") == "finished" and status["frames"] >= self.cfg.total_frames

    def begin(self, students: Students) -> None:
        """Load the students' last checkpoint if the run is to be resumed, remove what an earlier run left if not."""
        self.frames = 0
        if not self.cfg.resume:
            self.checkpoints.clear()
            for name in ("teacher.json", "trials.json", "policy.safetensors"):  # a trial may not come again
                (self.folder.path / name).unlink(missing_ok=True)
        elif self.checkpoints.load({"stage": students}, students.parts):
            self.frames = students.frames
            self.evaluations = _rows_until(self.folder.path / "eval.csv", self.frames)
            self.metrics = _rows_until(self.folder.path / "metrics.csv", self.frames)
        self.next_evaluation = _next_multiple(self.frames, self.cfg.evaluation.interval)
        self.next_checkpoint = _next_multiple(self.frames, self.cfg.checkpoint.interval)
        self.set_status("running", frames=self.frames)
        self.bar = progress_bar(
            total=self.cfg.total_frames, initial=self.frames, unit="frame", unit_scale=True, disable=in_sweep()
        )
        self.logger = None
        if self.cfg.logger != "csv":
            path, matters = self.folder.path, self.folder.config
            identity = f"{path.name}-{digest(matters | {'out': str(path.resolve())})}"
            self.logger = RunLogger(self.cfg.logger, path, matters, self.frames, identity)

    def announce(self, text: str) -> None:
        """Say in the progress bar what takes its time, until the next rollout is logged."""
        self.bar.set_description(text)

    def log(
        self, frames: int, metrics: dict[str, Tensor], weights: Tensor | None = None, arm: str | None = None
    ) -> None:
        """Keep one rollout's metrics, in a trial with whose they are; its states' prior weights go to the logger only.

        Raises:
            TrainingError: a loss is not finite.
        """
        row = {"frames": frames} | {name: value.item() for name, value in metrics.items()}
        bad = [name for name, value in row.items() if name.startswith("loss_") and not math.isfinite(value)]
        if bad:
            last = self.checkpoints.newest()
            raise TrainingError(
                f"{', '.join(bad)} became NaN or infinite at {frames} frames; the last checkpoint before it is {last}."
            )
        self.metrics.append(row if arm is None else {"arm": arm} | row)
        self.bar.set_description(None, refresh=False)
        self.bar.update(frames - self.frames)
        self.frames = frames
        if self.logger is not None:
            prefix = "train" if arm is None else f"train/{arm}"
            self.logger.scalars(prefix, row)
            if weights is not None:
                self.logger.histogram(f"{prefix}/prior_weights", weights, frames)

    def log_trials(self, results: Sequence[TrialResult]) -> None:
        """Keep who won the trials so far, and say who won the last."""
        self.folder.write("trials.json", json.dumps([result._asdict() for result in results], indent=1))
        tqdm.write(f"{self.folder.path}: {results[-1]}", file=sys.stderr)

    def evaluation_is_due(self, frames: int) -> bool:
        """Whether the policy is to be evaluated now: every ``evaluation.interval`` frames and at the end."""
        if frames < self.next_evaluation and frames < self.cfg.total_frames:
            return False
        self.next_evaluation = _next_multiple(frames, self.cfg.evaluation.interval)
        return True

    def log_evaluation(self, frames: int, result: Evaluation) -> None:
        """Keep an evaluation."""
        returns = result.returns
        row = {
            "frames": frames,
            "mean_return": returns.mean().item(),
            "std_return": returns.std(correction=0).item(),
            "min_return": returns.min().item(),
            "max_return": returns.max().item(),
            "mean_length": result.lengths.double().mean().item(),
            "episodes": len(returns),
        }
        self.evaluations.append(row)
        self.bar.set_postfix({"return": f"{row['mean_return']:.0f}"})
        if in_sweep():  # bars of several runs would overwrite each other
            print(f"{self.folder.path}: return {row['mean_return']:.1f} at {frames} frames", flush=True)
        if self.logger is not None:
            self.logger.scalars("eval", row)
        self._write_tables()

    def checkpoint_if_due(self, students: Students) -> None:
        """Save the students every ``checkpoint.interval`` frames, at the end, and when the process is to stop.

        Raises:
            Stopped: it is to stop.
        """
        frames = students.frames
        if frames >= self.next_checkpoint or frames >= self.cfg.total_frames or self.is_to_stop:
            self.next_checkpoint = _next_multiple(frames, self.cfg.checkpoint.interval)
            self._write_tables()
            self.checkpoints.save(students.parts(), frames)
            self.set_status("running", frames=frames)
        if self.is_to_stop and frames < self.cfg.total_frames:
            raise Stopped(f"{self.folder.path}: asked to stop, saved at {frames} frames")

    def finish(self, actor: Any, normalizer: Any, env_id: str, arm: str | None = None) -> None:
        """Export the policy as a teacher, and say that the run is done."""
        last = self.evaluations[-1]
        save_prior(
            self.folder.path / "policy.safetensors",
            policy_prior(actor, normalizer),
            env_id=env_id,
            seed=self.cfg.seed,
            frames=self.frames,
            evaluation=last,
            training={"method": self.cfg.method, "recipe": "recipes.mujoco"},
        )
        self.bar.close()
        if self.logger is not None:
            self.logger.close()
        whose = {} if arm is None else {"arm": arm}
        self.set_status("finished", frames=self.frames, mean_return=last["mean_return"], **whose)
        print(f"{self.folder.path}: finished, return {last['mean_return']:.1f} at {self.frames} frames", flush=True)

    def _write_tables(self) -> None:
        for name, rows in (("eval", self.evaluations), ("metrics", self.metrics)):
            self.folder.write(f"{name}.csv", pd.DataFrame(rows).to_csv(index=False))


class Stopped(Exception):
    """The process was asked to end, and the run is saved."""


class Supervisor:
    """Around a run: however it ends, its status says so, and the process ends as it should."""

    run: Run | None = None
    """The run, as soon as there is a status to write."""
    error: str | None = None
    """Why it failed, in a sweep, whose other runs go on."""

    def __enter__(self) -> Supervisor:
        self._notice = Notice(self._stop)
        return self

    def _stop(self, *_: Any) -> None:
        """What a cluster sends before it takes the machine away: the run is saved after the rollout at hand."""
        if self.run is None:
            self._notice.leave(143)
        self.run.is_to_stop = True

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback_: Any) -> bool:
        self._notice.release()
        if isinstance(error, (KeyboardInterrupt, Stopped)):
            interrupted = isinstance(error, KeyboardInterrupt)
            self._end("interrupted")
            said = "Interrupted" if interrupted else error
            print(f"{said}: the same command continues.", file=sys.stderr, flush=True)
            if interrupted:
                sys.exit(130)
            self._notice.leave(143)
        if isinstance(error, Exception):
            self._end("failed", error=str(error))
            if not isinstance(error, (ValueError, OSError, ImportError, TrainingError)):
                traceback.print_exc()
            self.error = fail(f"Error: {error}")
        return self.error is not None

    def _end(self, state: str, **more: Any) -> None:
        """The run's last words."""
        if self.run is not None:
            with suppress(OSError):  # a full disk, say
                self.run.set_status(state, frames=self.run.frames, **more)
            self.run.folder.release()


def _next_multiple(frames: int, interval: int) -> int:
    return (frames // interval + 1) * interval


def _rows_until(path: Path, frames: int) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    rows = pd.read_csv(path, float_precision="round_trip").to_dict("records")
    return [row for row in rows if row["frames"] <= frames]
