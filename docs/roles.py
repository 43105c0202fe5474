"""Docstrings are written with Sphinx's roles, as TorchRL's are: here they become Markdown."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:class|func|meth|attr|data|mod|exc):`(~?)([^`]+)`")
_MATH = re.compile(r":math:`([^`]+)`")
_MATH_BLOCK = re.compile(r"^( *)\.\. math::\n((?:\n|\1 +.*\n?)+)", flags=re.MULTILINE)
_NOTE = re.compile(r"^( *)\.\. note:: ?(.*)$", flags=re.MULTILINE)


def _role(match: re.Match[str]) -> str:
    short, path = match[1], match[2]
    shown = path.rpartition(".")[2] if short else path
    if not path.startswith("torchrl_priors."):
        return f"`{shown}`"
    return f'<autoref identifier="{path}" optional><code>{shown}</code></autoref>'


def _math_block(match: re.Match[str]) -> str:
    lines = (line.strip() for line in match[2].strip().splitlines())
    return f"\n{match[1]}$$\n" + "\n".join(match[1] + line for line in lines if line) + f"\n{match[1]}$$\n\n"


def to_markdown(text: str) -> str:
    """A docstring with Markdown in place of roles and directives."""
    text = _MATH_BLOCK.sub(_math_block, text)
    text = _NOTE.sub(r"\1!!! note\n\n\1    \2", text)
    return _MATH.sub(lambda match: f"${match[1]}$", _ROLE.sub(_role, text))


class Roles(griffe.Extension):
    """Converts every docstring that is shown."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Called for each object, before its docstring is parsed."""
        if obj.docstring is not None:
            obj.docstring.value = to_markdown(obj.docstring.value)
