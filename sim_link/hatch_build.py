"""Build hook of both distributions: wheels bring man pages and bash completions.

They are generated from the commands' argument parsers, where these and the two generators can be
imported: `make dist` can, an isolated build (`pip install .`) cannot and leaves them out.
"""

from __future__ import annotations

import argparse
import atexit
import importlib
import os
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PARSERS = {
    "companion-guidance": ("companion.arguments", "argument_parser"),
    "companion-sim-link": ("sim_link.cli", "simulator_parser"),
}


class ManualsHook(BuildHookInterface[Any]):
    """Adds the pages of one distribution below `share` of the environment."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Generate them for a wheel; an editable install has none."""
        if self.target_name != "wheel" or version != "standard":
            return
        folder = tempfile.TemporaryDirectory()
        atexit.register(folder.cleanup)
        try:
            write_manuals(self.metadata.name, self.metadata.version, Path(folder.name))
        except ImportError as error:
            self.app.display_warning(f"no man pages and completions: {error}")
            return
        build_data["shared_data"][folder.name] = "share"
        # hatchling would move these, too, to where the simulator's pyproject.toml moves its modules
        vars(self.build_config)["sources"] = {"share/": "share/", **self.build_config.sources}


def write_manuals(distribution: str, version: str, share: Path) -> None:
    """Write the man page and the bash completion of a distribution's command below `share`."""
    import shtab
    from argparse_manpage.manpage import Manpage

    module, function = PARSERS[distribution]
    parser: argparse.ArgumentParser = getattr(importlib.import_module(module), function)()
    built_at = datetime.fromtimestamp(int(os.environ.get("SOURCE_DATE_EPOCH", "315532800")), UTC)
    facts = {
        "description": (parser.description or "").partition(".")[0].replace("\n", " "),
        "project_name": distribution,
        "version": version,
        "manual_title": "User commands",
        "date": f"{built_at:%Y-%m-%d}",
    }
    for path, text in (
        (f"man/man1/{parser.prog}.1", str(Manpage(parser, _data=facts))),
        (f"bash-completion/completions/{parser.prog}", shtab.complete(parser, "bash")),
    ):
        target = share / path
        target.parent.mkdir(parents=True)
        target.write_text(text)
