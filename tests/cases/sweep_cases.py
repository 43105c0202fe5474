"""A sweep whose runs do nothing, and files of runs to compare."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pandas as pd

ROOT = Path(__file__).parents[2]

# A recipe that does nothing, below the configuration of those that do: its launchers are theirs.
RECIPE = """
import os
import signal
import time
import hydra
from hydra.core.config_store import ConfigStore
import recipes.common.sweeps

ConfigStore.instance().store(
    name="nothing",
    node={
        "defaults": ["_self_", {"override hydra/launcher": "cores"}],
        "seed": 0,
        "raises": -1,
        "fails": -1,
        "dies": -1,
        "lasts": 0,
        "out": "out",
        "hydra": {
            "run": {"dir": "."},
            "sweep": {"dir": "sweep", "subdir": "."},
            "output_subdir": None,
            "callbacks": {"summary": {"_target_": "recipes.common.sweeps.SweepSummary"}},
        },
    },
)

@hydra.main(version_base="1.3", config_path="{conf}", config_name="nothing")
def main(cfg):
    if cfg.seed == cfg.raises:
        raise ValueError(f"seed {cfg.seed} is broken")
    if cfg.seed == cfg.fails:
        return "Error: it failed"
    if cfg.seed == cfg.dies:
        os.kill(os.getpid(), signal.SIGKILL)
    with open(f"{cfg.out}/{cfg.seed}", "w") as file:
        file.write(f"{os.getpid()} {os.environ.get('OMP_NUM_THREADS')}")
    time.sleep(cfg.lasts)

if __name__ == "__main__":
    recipes.common.sweeps.start(main, "nothing")
"""


def start_sweep(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """Sweep in a folder."""
    (folder / "nothing.py").write_text(RECIPE.replace("{conf}", str(ROOT / "conf")))
    (folder / "out").mkdir()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "nothing.py", "-m", *arguments]
    pipe = subprocess.PIPE
    # a job in the background of a shell ignores Ctrl-C, and what it starts does so too
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        stdout=pipe,
        stderr=pipe,
        text=True,
        start_new_session=True,
        preexec_fn=heed,
    )


def done(folder: Path) -> dict[str, list[str]]:
    """The process and the threads of each run of a sweep that came to its end."""
    return {file.name: file.read_text().split() for file in sorted((folder / "out").iterdir()) if file.stat().st_size}


def sweep(folder: Path, *arguments: str) -> tuple[subprocess.CompletedProcess[str], dict[str, list[str]]]:
    """Sweep in a folder to the end; what was said, and what was done."""
    process = start_sweep(folder, *arguments)
    said = process.communicate()
    return subprocess.CompletedProcess(process.args, process.returncode, *said), done(folder)


def at_work(out: Path, progress: str) -> dict[int, Path]:
    """The processes that hold the folder of a run that has some file, and the folder of each: of Linux only."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            held = {os.readlink(file) for file in process.glob("fd/*")}
        except OSError:  # another user's, or it has ended
            continue
        for folder in out.glob("*"):
            if str(folder / ".lock") in held and [*folder.glob(progress)]:
                found[int(process.name)] = folder
    return found


def alive(pid: int) -> bool:
    """Whether a process is at work, which one that waits to be noticed is not: of Linux only."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_for(something: Callable[[], object], process: subprocess.Popen) -> None:
    while not something():
        assert process.poll() is None, "the sweep ended"
        time.sleep(0.02)


def results(run: Path) -> dict[str, bytes]:
    """What must be the same however a run came to its end: all of its tables but for the speed, and the policy."""
    kept = {name: (run / name).read_bytes() for name in ("eval.csv", "policy.safetensors")}
    metrics = pd.read_csv(run / "metrics.csv", dtype=str).drop(columns="fps")
    return kept | {"metrics.csv": metrics.to_csv().encode()}
