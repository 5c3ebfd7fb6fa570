"""Hooks of mkdocs: pages of the checkout's root, and links that lead out of `docs`.

The pages are written for a checkout, where `../configs/x.yaml` is a link. On the site there is no
such file: the link's words stay, without a link. CHANGELOG.md and CONTRIBUTING.md are pages of it.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
OF_ROOT = ("CHANGELOG.md", "CONTRIBUTING.md")
OUTSIDE = re.compile(r"\[([^\]]+)\]\((?:\.\./)+(?P<path>[^)]*)\)")
INTO_DOCS = re.compile(r"\]\(docs/")


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the root."""
    from mkdocs.structure.files import File

    for name in OF_ROOT:
        files.append(File.generated(config, name, content=(ROOT / name).read_text("utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Give a page the links that the site has."""
    if page.file.src_uri in OF_ROOT:
        return OUTSIDE.sub(_words, INTO_DOCS.sub("](", markdown))
    if "/" in page.file.src_uri:
        return re.sub(r"\[([^\]]+)\]\(\.\./\.\./(?P<path>[^)]*)\)", _words, markdown)
    return OUTSIDE.sub(_words, markdown)


def _words(link: re.Match[str]) -> str:
    path = link["path"]
    return f"[{link[1]}]({path})" if path.partition("#")[0] in OF_ROOT else link[1]
