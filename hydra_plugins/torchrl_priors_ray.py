"""Runs of a sweep side by side by Ray, on this machine or on a cluster: ``conf/hydra/launcher/ray.yaml``.

Hydra looks for launchers in modules under ``hydra_plugins`` only, and finds this one in the checkout that a recipe runs
from. The plug-in ``hydra-ray-launcher`` ends the sweep with the first run whose process dies too often, and it needs
versions of other packages that the tests don't run with.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, configure_log, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

#: No reports to Ray's makers, and the devices that the user chose; a user may say otherwise.
_SETTINGS = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
#: Bytes for the results of runs, which are a line each: near the least that Ray takes.
_STORE = 80 * 2**20


class RayLauncher(Launcher):
    """Each run is a task of Ray. One whose process dies is started again; one that keeps dying is a run that failed.

    Args:
        address (str, optional): of a cluster; ``None`` starts Ray on this machine, and ends it after the sweep.
        workers (int, optional): runs at a time on this machine; ``None`` is one for each core.
        cpus_per_run (int): cores that a run is counted as.
        max_retries (int): how often a run is started again; -1 is without end.
    """

    def __init__(self, address: str | None, workers: int | None, cpus_per_run: int, max_retries: int) -> None:
        self.address, self.workers = address, workers
        self.cpus_per_run, self.max_retries = cpus_per_run, max_retries

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Keep what Hydra hands to a launcher."""
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Start the runs, and wait for all of them."""
        for name, value in _SETTINGS.items():
            os.environ.setdefault(name, value)
        import ray  # here: Hydra imports this module for every command

        configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        Path(self.config.hydra.sweep.dir).mkdir(parents=True, exist_ok=True)
        local = {
            "address": "local",
            "num_cpus": self.workers,
            "object_store_memory": _STORE,
            "include_dashboard": False,
        }
        ray.init(logging_level="error", **({"address": self.address} if self.address else local))
        try:
            start = ray.remote(num_cpus=self.cpus_per_run, max_retries=self.max_retries)(_run)
            configs = [self._config(*numbered) for numbered in enumerate(job_overrides, initial_job_idx)]
            shared = (self.hydra_context, self.task_function, Singleton.get_state(), os.getcwd())
            runs = [start.remote(config, *shared) for config in configs]
            return [self._outcome(run, config) for run, config in zip(runs, configs, strict=True)]
        finally:
            ray.shutdown()

    def _config(self, number: int, overrides: Sequence[str]) -> DictConfig:
        config = self.hydra_context.config_loader.load_sweep_config(self.config, list(overrides))
        with open_dict(config):
            config.hydra.job.id = config.hydra.job.num = number
        return config

    def _outcome(self, run: Any, config: DictConfig) -> JobReturn:
        """What a run returned; or, as a run that fails does, the error that it ended by."""
        import ray

        try:
            return ray.get(run)
        except ray.exceptions.RayError as error:
            lost = JobReturn(overrides=config.hydra.overrides.task, status=JobStatus.COMPLETED)
            name = type(error).__name__
            lost.return_value = f"Error: Ray lost the run ({name}, max_retries={self.max_retries}): {error}"
            self.hydra_context.callbacks.on_job_end(config=config, job_return=lost)
            return lost


def _run(
    config: DictConfig, context: HydraContext, task: TaskFunction, singletons: dict[Any, Any], folder: str
) -> JobReturn:
    """In a process of Ray's, which on a cluster is in a folder of its own."""
    os.chdir(folder)
    setup_globals()
    Singleton.set_state(singletons)
    return run_job(
        hydra_context=context,
        task_function=task,
        config=config,
        job_dir_key="hydra.sweep.dir",
        job_subdir_key="hydra.sweep.subdir",
    )
