"""What the site takes from the rest of the repository: text, figures and tables of results; and formulas as MathML."""

from __future__ import annotations

import csv
import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
STUDIES = ("original", "shaped", "beyond", "comparisons")
_INCLUDE = re.compile(r'^--8<-- "([\w.]+)(?::(\w+))?"$', flags=re.MULTILINE)
_FILE_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?://|#)[^)]+\)")
_TABLE = re.compile(r"<!-- area ratios: ([\w, ]+) -->")
_FORMULA = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', flags=re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Adds the figures of ``results/``, under the path that they have in the repository."""
    for path in sorted((ROOT / "results").rglob("*.png")):
        files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Puts in what a page takes from other files: text, and the tables of results that a comment names."""
    markdown = _INCLUDE.sub(lambda match: included(match[1], match[2]), markdown)
    return _TABLE.sub(lambda match: area_ratios(match[1].split(", ")), markdown)


def on_page_content(content: str, **kwargs: Any) -> str:
    """Turns LaTeX into MathML, which browsers draw by themselves: no script is loaded to read a page."""
    return _FORMULA.sub(_formula, content)


def included(name: str, section: str | None) -> str:
    """A file of the repository, or what is between the markers of a section; its links to files are text here."""
    text = (ROOT / name).read_text(encoding="utf-8")
    if section is not None:
        start, end = (f"<!-- --8<-- [{side}:{section}] -->" for side in ("start", "end"))
        text = text[text.index(start) + len(start) : text.index(end)]
    return _FILE_LINK.sub(r"\1", text)


def area_ratios(methods: list[str]) -> str:
    """IQM of the area ratio × 1000 and its interval, for each study that has the method."""
    found: dict[tuple[str, str], dict[str, str]] = {}
    priors: dict[str, None] = {}
    for study in STUDIES:
        with (ROOT / f"results/gridworld/{study}/area_ratio.csv").open(encoding="utf-8") as file:
            for row in csv.DictReader(file):
                iqm, low, high = (round(1000 * float(row[name])) for name in ("iqm", "ci_low", "ci_high"))
                found.setdefault((study, row["method"]), {})[row["prior"]] = f"{iqm} ({low}, {high})"
                priors[row["prior"]] = None
    for method in {method for study, method in found if study == "beyond"}:
        found.pop(("comparisons", method), None)  # the same worlds and numbers once more
    columns = [(study, method) for method in methods for study in STUDIES if (study, method) in found]
    if not columns:
        raise ValueError(f"No study has the methods {', '.join(methods)}.")
    names = [study if len(methods) == 1 else f"{method}, {study}" for study, method in columns]
    lines = ["| prior | " + " | ".join(names) + " |", "|---" + "|---:" * len(names) + "|"]
    lines += [
        "| " + " | ".join([prior, *(found[column].get(prior, "") for column in columns)]) + " |" for prior in priors
    ]
    return "\n".join(lines)


def _formula(match: re.Match[str]) -> str:
    latex = html.unescape(match[2]).strip().removeprefix(r"\(").removesuffix(r"\)")
    latex = latex.removeprefix(r"\[").removesuffix(r"\]").strip()
    return convert(latex, display="block" if match[1] == "div" else "inline")
