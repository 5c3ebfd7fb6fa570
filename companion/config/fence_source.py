"""A fence from a file: which format it is, and whether it makes a fence."""

from __future__ import annotations

from pathlib import Path

from companion.config.fence_kml import areas_of_kml
from companion.config.fence_plan import areas_of_plan
from companion.config.load import read_text
from companion.errors import ConfigError
from companion.geometry.geofence import GeoFence, fence_of

MAX_BYTES = 10_000_000
"""A plan with the mission of a whole day is smaller."""
READERS = {".plan": areas_of_plan, ".kml": areas_of_kml}


def read_fence(path: Path) -> GeoFence:
    """The fence in a QGroundControl `.plan` or a `.kml` file.

    Raises:
        ConfigError: It cannot be read or holds no fence; one line names the file and the element.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        kinds = " or ".join(READERS)
        hint = "; unpack it, there is a .kml in it" if path.suffix.lower() == ".kmz" else ""
        raise ConfigError(f"{path}: a fence is a {kinds} file{hint}")
    try:
        return fence_of(reader(read_text(path, MAX_BYTES)))
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
