"""How the runs of a sweep (``-m``) are started: ``hydra/launcher=cores``, or one of ``conf/hydra/launcher``.

``cores`` is ``ray``, which runs them side by side on this machine or on a cluster, where the extra ``sweeps`` is
installed, and one after the other where it isn't, so that a recipe can name it as its default. It is no YAML file
because it depends on what is installed. Each run is one thread; recipes see to that themselves.

A run that fails does not stop the others: it returns its error, and :class:`SweepSummary`, named under
``hydra.callbacks``, lists the errors when all have ended.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

__all__ = ["SweepSummary", "cores", "fail", "in_sweep", "start"]


def cores(installed: bool) -> dict[str, Any]:
    """The launcher ``cores``: a process per core, or Hydra's own launcher without Ray."""
    return {"defaults": ["ray" if installed else "basic"]}


ConfigStore.instance().store(group="hydra/launcher", name="cores", node=cores(find_spec("ray") is not None))


def start(main: Callable[[], Any], name: str) -> None:
    """Run the command of the recipe ``conf/<name>.yaml``, or say its help. Ctrl-C ends it with a line.

    ``key=~/x`` is in one's home directory, which the shell and Hydra leave to others.
    """
    if {"--help", "-h"} & set(sys.argv[1:]):
        from recipes.common.help import help_text  # here: it imports torch, which a sweep itself has no use for

        print(help_text(name))
        return
    home = re.compile(r"(?<==)~(?=/|$)")
    sys.argv[1:] = [home.sub(str(Path.home()), word) for word in sys.argv[1:]]
    try:
        main()
    except KeyboardInterrupt:
        print("Interrupted: the same command continues.", file=sys.stderr, flush=True)
        sys.exit(130)


def in_sweep() -> bool:
    """Whether this run is one of several (``-m``)."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def fail(message: str) -> str:
    """End the process with a message; in a sweep only print it, to be returned from the recipe's ``main``."""
    if not in_sweep():
        sys.exit(message)
    print(message, file=sys.stderr, flush=True)
    return message


class SweepSummary(Callback):
    """At the end of a sweep names the runs that failed, and exits with 1 if there are any.

    Each run leaves its outcome in ``jobs/<number>.json`` of the sweep's folder, whichever process or node it ran on.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Forget an earlier sweep in the same folder."""
        shutil.rmtree(_jobs(config), ignore_errors=True)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Keep the outcome of a run."""
        if config.hydra.mode == RunMode.MULTIRUN and job_return.status == JobStatus.COMPLETED:
            file = _jobs(config) / f"{config.hydra.job.num}.json"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(
                json.dumps({"overrides": list(job_return.overrides or ()), "error": job_return.return_value})
            )

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Print the summary."""
        files = sorted(_jobs(config).glob("*.json"), key=lambda file: int(file.stem))
        outcomes = [json.loads(file.read_text()) for file in files]
        failed = [outcome for outcome in outcomes if outcome["error"]]
        print(
            f"Sweep: {len(outcomes) - len(failed)} of {len(outcomes)} runs are done, {len(failed)} failed.", flush=True
        )
        same = set.intersection(*(set(outcome["overrides"]) for outcome in outcomes)) if len(outcomes) > 1 else set()
        for outcome in failed:
            name = " ".join(override for override in outcome["overrides"] if override not in same)
            print(f"Failed: {name}: {outcome['error']}", file=sys.stderr)
        if failed:
            sys.exit(1)


def _jobs(config: DictConfig) -> Path:
    return Path(config.hydra.sweep.dir) / "jobs"
