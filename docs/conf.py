"""The documentation. ``make docs`` builds it into ``site/`` without the network; a warning is an error."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.util.inspect import signature as signature_of
from sphinx.util.inspect import stringify_signature

sys.path.insert(0, str(Path(__file__).parent))  # the modules beside this file

from projects import ALIASES, URLS

project = "torchrl_priors"
author = "The torchrl_priors authors"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "sphinx.ext.napoleon",
    "area_ratios",
    "mathml",
]

html_theme = "pydata_sphinx_theme"
html_title = project
html_theme_options = {
    "navbar_end": ["theme-switcher"],
    "footer_start": [],
    "footer_end": [],
    "show_prev_next": False,
    "show_toc_level": 2,
}
html_show_sourcelink = False
pygments_style = "friendly"

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

autodoc_default_options = {"members": True, "member-order": "bysource", "exclude-members": "default_keys"}
autodoc_inherit_docstrings = False
autodoc_typehints = "none"  # the docstrings say them, with shapes
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]
napoleon_use_keyword = False
napoleon_use_param = False  # several arguments share one description, as in TorchRL
napoleon_use_rtype = False

nitpicky = True
nitpick_ignore = [("py:class", "Tensor")]  # the type of a named tuple's field
intersphinx_mapping = {name: (url, f"_inventories/{name}.txt") for name, url in URLS.items()}

_FILE_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?://|#)[^)]+\)")


def without_file_links(app: Any, path: Path, parent: str, content: list[str]) -> None:
    """What is included from outside this folder: its links to files are text here."""
    content[0] = _FILE_LINK.sub(r"\1", content[0])


def written_signature(app: Any, what: str, name: str, obj: Any, options: Any, signature: str, result: str) -> Any:
    """What ``__init__`` takes, where a metaclass of TorchRL hides it."""
    if what == "class" and signature == "(*args, **kwargs)":
        signature = stringify_signature(signature_of(obj.__init__, bound_method=True), show_annotation=False)
    return signature, result


def anywhere(app: Any, doctree: nodes.document) -> None:
    """A name without its module is looked for in every module, its own first."""
    for node in doctree.findall(pending_xref):
        node["refspecific"] = True


def under_its_alias(app: Any, env: Any, node: Any, contnode: Any) -> None:
    """Before other projects' names are looked up: the name that is documented."""
    node["reftarget"] = ALIASES.get(node["reftarget"], node["reftarget"])


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", written_signature)
    app.connect("include-read", without_file_links)
    app.connect("doctree-read", anywhere)
    app.connect("missing-reference", under_its_alias, priority=400)
