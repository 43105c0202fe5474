"""Writes ``docs/_inventories``: where other projects document the names that docstrings and pages refer to.

    make inventories

It needs the network; a build does not. Run it after a new reference to another project, or for a new version of one.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from urllib.request import urlopen

from projects import ALIASES, URLS
from sphinx.util.inventory import InventoryFile

DOCS = Path(__file__).parent
ROLE = re.compile(r"(?::py)?[:{](?:class|func|meth|attr|data|mod|exc)[:}]`~?([\w.]+)`")


def names_used() -> set[str]:
    """Every name in a role, in the docstrings and in the pages."""
    code = [file for folder in ("torchrl_priors", "recipes") for file in (DOCS.parent / folder).rglob("*.py")]
    files = [*code, *DOCS.rglob("*.md"), *DOCS.rglob("*.rst")]
    names = {name for file in files for name in ROLE.findall(file.read_text(encoding="utf-8"))}
    return {ALIASES.get(name, name) for name in names}


def selected(project: str, content: bytes, names: set[str]) -> str:
    """The entries of these names as an inventory of version 1, which is text: a name, a kind and a page a line."""
    inventory = InventoryFile.loads(content, uri="")
    lines = [
        f"{name} {kind.removeprefix('py:').replace('module', 'mod')} {item.uri.partition('#')[0]}"
        for kind, items in inventory.data.items()
        if kind.startswith("py:")
        for name, item in items.items()
        if name in names
    ]
    head = ["# Sphinx inventory version 1", f"# Project: {project}", "# Version: the one that its URL names"]
    return "\n".join([*head, *sorted(lines), ""])


def main() -> int:
    """Download, select and write; the number of names that were not found."""
    names, missing = names_used(), set()
    for project, url in URLS.items():
        with urlopen(f"{url}objects.inv") as answer:
            text = selected(project, answer.read(), names)
        (DOCS / "_inventories" / f"{project}.txt").write_text(text, encoding="utf-8")
        written = {line.split()[0] for line in text.splitlines() if not line.startswith("#")}
        missing |= {name for name in names if name.startswith(f"{project}.")} - written
    for name in sorted(missing):
        print(f"{name}: not in the project's inventory", file=sys.stderr)
    return len(missing)


if __name__ == "__main__":
    sys.exit(main())
