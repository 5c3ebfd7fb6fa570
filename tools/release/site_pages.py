"""Hooks of mkdocs: pages of the checkout's root, and links that lead out of `docs`.

The pages are written for a checkout, where `../configs/x.yaml` is a link. The site has no such
file: the link's text stays, without a link. CHANGELOG.md and CONTRIBUTING.md become pages. Links
whose text is a file name get the page's name in the menu.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
OF_ROOT = ("CHANGELOG.md", "CONTRIBUTING.md")
OUTSIDE = re.compile(r"\[([^\]]+)\]\((?:\.\./)+(?P<path>[^)]*)\)")
INTO_DOCS = re.compile(r"\]\(docs/")
BY_FILE = re.compile(r"\[(?:[\w-]+/)*[\w-]+\.md\]\((?P<path>[\w/.-]+\.md)(?P<anchor>#[^)]*)?\)")


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the root."""
    from mkdocs.structure.files import File

    for name in OF_ROOT:
        files.append(File.generated(config, name, content=(ROOT / name).read_text("utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Return a page with the links that the site has."""
    here = page.file.src_uri
    if here in OF_ROOT:
        markdown = OUTSIDE.sub(_words, INTO_DOCS.sub("](", markdown))
    elif "/" in here:
        markdown = re.sub(r"\[([^\]]+)\]\(\.\./\.\./(?P<path>[^)]*)\)", _words, markdown)
    else:
        markdown = OUTSIDE.sub(_words, markdown)
    names = dict(_named(config["nav"]))

    def named(link: re.Match[str]) -> str:
        """Return a link with the name of its page, if it has one."""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(here), link["path"]))
        name = names.get(path)
        return link[0] if name is None else f"[{name}]({link['path']}{link['anchor'] or ''})"

    return BY_FILE.sub(named, markdown)


def _named(menu: Any) -> Iterator[tuple[str, str]]:
    """Yield the pages of a menu with their names there."""
    for entry in menu:
        for name, below in entry.items():
            if isinstance(below, str):
                yield below, name
            else:
                yield from _named(below)


def _words(link: re.Match[str]) -> str:
    path = link["path"]
    return f"[{link[1]}]({path})" if path.partition("#")[0] in OF_ROOT else link[1]
