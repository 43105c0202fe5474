"""What the package's metadata says of its repository, which only who publishes it knows.

The publishing workflow puts its address into ``REPOSITORY_URL``. Its pages become the project's URLs, and relative
links of the README become absolute, for a package index shows it without the files beside it.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(?P<image>!?)\[(?P<text>[^\]]*)\]\((?!https?://|#)(?P<path>[^)]+)\)")


class Metadata(MetadataHookInterface):
    """Fills in ``readme`` and ``urls``."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Called by hatchling."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["urls"] = {"Paper": "https://arxiv.org/abs/2209.09882"}
        if url := os.environ.get("REPOSITORY_URL", "").rstrip("/"):
            ref = f"v{metadata['version']}"
            metadata["urls"] |= {
                "Repository": url,
                "Documentation": f"{url}/tree/{ref}/docs",
                "Changelog": f"{url}/blob/{ref}/CHANGELOG.md",
                "Issues": f"{url}/issues",
            }
            text = absolute(text, url, ref)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def absolute(text: str, url: str, ref: str) -> str:
    """Markdown whose relative links lead to the repository's files, and whose pictures to the files themselves."""

    def link(match: re.Match[str]) -> str:
        kind = "raw" if match["image"] else "blob"
        return f"{match['image']}[{match['text']}]({url}/{kind}/{ref}/{match['path']})"

    return LINK.sub(link, text)
