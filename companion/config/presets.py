"""Locations of the configurations that come with the program: presets, radios, the service unit."""

from __future__ import annotations

from pathlib import Path

from companion.errors import ConfigError

_PACKAGE = Path(__file__).parents[1]
CONFIG_FOLDERS = (Path("configs"), _PACKAGE.parent / "configs", _PACKAGE / "configs")
"""Folders in the working directory, in the checkout and in the installed package; the first that
exists counts."""
PRESETS = ("companion", "radios")


def shipped_file(name: str) -> Path:
    """Return a file below `configs` of the program itself; raise `ConfigError` if it is missing.

    The working directory is not searched: root installs the file found here.
    """
    for folder in CONFIG_FOLDERS[1:]:
        if (folder / name).is_file():
            return folder / name
    raise ConfigError(f"configs/{name}: not in this installation; reinstall companion-guidance")


def preset_named(name: str) -> Path:
    """Return the file of a preset: a path, or its name below the folders of `PRESETS`."""
    path = Path(name)
    if path.is_file():
        return path
    for folder in CONFIG_FOLDERS:
        for kind in PRESETS:
            file = folder / kind / f"{name}.yaml"
            if file.is_file():
                return file
    raise ConfigError(f"preset {name}: no such file, and none of {', '.join(preset_names())}")


def preset_names() -> list[str]:
    """Return the names that `preset_named` knows."""
    names = {
        str(file.relative_to(folder / kind).with_suffix(""))
        for folder in CONFIG_FOLDERS
        for kind in PRESETS
        for file in (folder / kind).rglob("*.yaml")
    }
    return sorted(names)
