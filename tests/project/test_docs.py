"""What the documentation tells a reader to type works; what it says of the library is there."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from mujoco_cases import without_records
from test_readme import a_readers_own_objects
from torchrl.objectives.value import GAE

from torchrl_priors import ActionPrior, PriorBonus, PriorLogProb, PriorWeight
from torchrl_priors.methods import METHODS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = {path.relative_to(DOCS).as_posix(): path.read_text(encoding="utf-8") for path in sorted(DOCS.rglob("*.md"))}
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", flags=re.DOTALL | re.MULTILINE)

# What makes the commands short: appended to each of a recipe. Lengths and sizes only, never what is shown.
SHORT = {
    "recipes.gridworld": "worlds=2 teacher.steps=200 teacher.eval_episodes=1 evaluation.points=3 "
    "evaluation.interval=20 bootstrap.reps=20",
    "recipes.mujoco": "env.num_envs=2 env.frames_per_batch=64 env.minibatch_size=32 total_frames=128 ppo.epochs=1 "
    "ppo.hidden=[8] evaluation.interval=64 evaluation.episodes=1 checkpoint.interval=128 compile=false "
    "trial.max_frames=64 trial.min_frames=64",
    "recipes.mujoco_study": "",
    "recipes.report": "bootstrap.reps=20",
    "recipes.export_best": "",
}


def blocks(language: str) -> dict[str, list[str]]:
    found = {page: [code for name, code in BLOCK.findall(text) if name == language] for page, text in PAGES.items()}
    return {page: codes for page, codes in found.items() if codes}


def run(command: str, folder: Path) -> int | str | None:
    """Run a recipe's command in this process, shortened, in a folder; what it exits with."""
    words = command.split()
    assert words[:2] == ["python", "-m"], f"{command}: no command that a test knows to run"
    assert words[2] in SHORT, f"{command}: no recipe that a test knows to make short"
    more = ["hydra/launcher=basic"] if "-m" in words[3:] else []
    more += ["+env.kwargs.max_episode_steps=16"] if "env.id=" in command else []  # in 64 frames episodes are to end
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("HYDRA_MAIN_MODULE", "__main__")  # find conf/ as the command does
        patch.setattr(sys, "argv", [words[2], *words[3:], *SHORT[words[2]].split(), *more])
        try:
            package = importlib.import_module(words[2])
            command_of = importlib.import_module(f"{words[2]}.__main__") if hasattr(package, "__path__") else package
            with without_records():
                command_of.main()
        except SystemExit as end:
            return end.code
    return None


def test_every_block_is_of_a_language_that_is_run() -> None:
    assert {name for text in PAGES.values() for name, _ in BLOCK.findall(text)} == {"bash", "python"}


# What a page's commands make.
MADE = {
    "guides/recipes.md": ["results/gridworld/original/area_ratio.csv", "outputs/report/report.md"],
    "guides/own_teacher.md": [
        f"outputs/mujoco/{name}/trial-*/teacher.json" for name in ("LunarLander-v3", "Pendulum-v1")
    ],
}


@pytest.fixture
def a_readers_teachers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The files that the pages speak of: a model of Stable-Baselines3, and the bot that a page shows."""
    PPO = pytest.importorskip("stable_baselines3").PPO
    PPO("MlpPolicy", "LunarLander-v3", policy_kwargs={"net_arch": [8]}, device="cpu").save(tmp_path / "ppo")
    (tmp_path / "bot.py").write_text(
        next(code for code in blocks("python")["guides/own_teacher.md"] if "def swing" in code)
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("bot", None)


@pytest.mark.usefixtures("without_pictures", "a_readers_teachers")
@pytest.mark.parametrize("page", blocks("bash"))
def test_commands_run_in_their_order(page: str, tmp_path: Path) -> None:
    for code in blocks("bash")[page]:
        for command in code.strip().splitlines():
            assert run(command, tmp_path) in (None, 0), command
    for made in MADE[page]:
        assert [*tmp_path.glob(made)], made


def names_of_the_first_page() -> dict[str, Any]:
    """What the loop of the first page has made before it starts."""
    names = a_readers_own_objects()
    prior, weight = ActionPrior(names["teacher"]), PriorWeight(names["weight_net"])
    return {**names, "prior": prior, "weight": weight, "log_prob": PriorLogProb(prior, names["actor"])}


@pytest.mark.parametrize("page", blocks("python"))
def test_examples_run_in_their_order(page: str) -> None:
    names = names_of_the_first_page()
    for number, code in enumerate(blocks("python")[page]):
        exec(compile(code, f"{page}, example {number}", "exec"), names)
    with torch.no_grad():  # as a collector does
        data = names["log_prob"](names["env"].rollout(20, names["actor"]))
        shaped = names.get("bonus", PriorBonus(shift="none"))(data)
        batch = GAE(gamma=0.99, lmbda=0.95, value_network=names["critic"])(shaped)
    if "listen" in names:
        names["listen"](batch)
    for name in ("loss", "loss_prior"):
        if name in names:
            losses = names[name](batch.copy())
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            assert all(value.isfinite().all() for value in losses.values())


@pytest.mark.parametrize("method", METHODS)
def test_every_method_has_a_page(method: str) -> None:
    text = PAGES[f"methods/{method}.md"]
    for part in ("$$", "**Notes.**", "**Can I use it?**", "**Results.**", "**How to replicate.**"):
        assert part in text, part


def test_everything_public_is_in_the_api() -> None:
    shown: set[int] = set()
    api = "\n".join(path.read_text(encoding="utf-8") for path in (DOCS / "api").glob("*.rst"))
    for kind, path in re.findall(r"^\.\. (auto\w+|py:data):: ([\w.]+)$", api, flags=re.MULTILINE):
        if kind == "automodule":
            module = importlib.import_module(path)
            shown |= {id(getattr(module, public)) for public in module.__all__}
        else:
            head, _, name = path.rpartition(".")
            shown.add(id(getattr(importlib.import_module(head), name)))
    for package in ("torchrl_priors", "torchrl_priors.artifacts", "torchrl_priors.collectors"):
        module = importlib.import_module(package)
        assert [name for name in module.__all__ if id(getattr(module, name)) not in shown] == []


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built without a network and with warnings as errors."""
    for package in ("sphinx", "myst_parser", "pydata_sphinx_theme", "latex2mathml"):
        pytest.importorskip(package)
    folder = tmp_path_factory.mktemp("site")
    from sphinx.cmd.build import main

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        for name in ("http_proxy", "https_proxy"):
            patch.setenv(name, "http://127.0.0.1:9")
        assert main(["-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(folder)]) == 0
    return folder


def test_the_site_builds_without_a_warning(site: Path) -> None:
    page = (site / "methods/ae2r.html").read_text(encoding="utf-8")
    formulas = re.findall("<math.*?</math>", page, flags=re.DOTALL)
    assert len(formulas) >= 5
    assert not any("\\" in formula or "&#x0005C;" in formula for formula in formulas)  # LaTeX that was not understood
    assert "$" not in re.sub("<(script|style).*?</\\1>", "", page, flags=re.DOTALL)
    assert "<table" in page


def test_a_docstring_refers_to_other_projects(site: Path) -> None:
    page = (site / "api/objectives.html").read_text(encoding="utf-8")
    assert "generated/torchrl.objectives.ClipPPOLoss.html#torchrl.objectives.ClipPPOLoss" in page
    assert 'href="transforms.html#torchrl_priors.PriorBonus"' in page


def test_no_page_needs_the_network(site: Path) -> None:
    """Neither fonts nor scripts nor styles of another host are loaded."""
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert re.findall(r"""<(?:script|img|iframe)[^>]*\ssrc=["'](?:https?:)?//""", text) == [], page
        assert re.findall(r"""<link[^>]*\shref=["'](?:https?:)?//""", text) == [], page
    for style in site.rglob("*.css"):
        assert re.findall(r"""(?:@import|url\()\s*["']?https?:""", style.read_text(encoding="utf-8")) == [], style


def test_the_inventories_hold_what_is_used_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(DOCS))
    inventories = importlib.import_module("inventories")
    names = inventories.names_used()
    for file in (DOCS / "_inventories").glob("*.txt"):
        lines = file.read_text(encoding="utf-8").splitlines()
        assert {line.split()[0] for line in lines if not line.startswith("#")} == {
            name for name in names if name.startswith(f"{file.stem}.")
        }, file
        published = "\n".join([*lines, f"{file.stem}.never_used function page.html"]).encode()
        assert inventories.selected(file.stem, published, names).splitlines() == lines
