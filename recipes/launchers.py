"""How the runs of a sweep (``-m``) are started: ``hydra/launcher=cores``, beside ``slurm`` in ``conf/hydra/launcher``.

``cores`` runs them side by side on this machine, as many as there are cores, where the extra ``sweeps`` is installed,
and one after the other where it isn't, so that a recipe can name it as its default. It is no YAML file because it
depends on what is installed. Each run is one thread; recipes see to that themselves.
"""

from __future__ import annotations

import importlib.util
from typing import Any

from hydra.core.config_store import ConfigStore

__all__ = ["cores"]


def _installed(plugin: str) -> bool:
    try:
        return importlib.util.find_spec(f"hydra_plugins.{plugin}") is not None
    except ModuleNotFoundError:  # no plug-in at all
        return False


def cores(installed: bool) -> dict[str, Any]:
    """The launcher ``cores``: a process per core, or Hydra's own launcher without the plug-in."""
    return {"defaults": ["joblib"], "n_jobs": -1} if installed else {"defaults": ["basic"]}


ConfigStore.instance().store(group="hydra/launcher", name="cores", node=cores(_installed("hydra_joblib_launcher")))
