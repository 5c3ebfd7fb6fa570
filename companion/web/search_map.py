"""The map as a page element; what it draws is in `search_map.js`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nicegui
from nicegui.element import Element

from companion.web.hub import Hub

LEAFLET = Path(nicegui.__file__).parent / "elements" / "leaflet" / "dist"
WHOLE_EVERY = 40
"""Pictures after which the whole track goes out again, should a part have been lost."""


class SearchMap(Element, component="search_map.js", esm={"nicegui-leaflet": str(LEAFLET)}):
    """Leaflet on a grid in metres, or on tiles from a folder.

    Args:
        scene: What does not change during the flight.
        tile_zooms: The least and the most zoom that there are tiles of; None: no tiles.
    """

    def __init__(self, scene: Mapping[str, Any], tile_zooms: tuple[int, int] | None) -> None:
        super().__init__()
        self.add_resource(LEAFLET)
        self._props["scene"] = dict(scene)
        self._props["zooms"] = tile_zooms
        self._sent = TrackSent()

    def show(self, hub: Hub) -> None:
        """Draw the latest moment.

        Args:
            hub: Has the picture, see `companion.view.picture`, and where the vehicle was.
        """
        points, is_whole = self._sent.next_part(hub)
        self.run_method("show", hub.picture, points, is_whole)


class TrackSent:
    """How much of the track a browser has: a flight long, it is more than all the rest."""

    def __init__(self) -> None:
        self._count = 0
        self._version = -1
        self._parts = 0

    def next_part(self, hub: Hub) -> tuple[list[tuple[float, float]], bool]:
        """What it lacks, and whether that is the whole track and not the end of it."""
        is_whole = hub.track_version != self._version or self._parts % WHOLE_EVERY == 0
        first = 0 if is_whole else self._count
        self._parts += 1
        self._count, self._version = len(hub.track), hub.track_version
        return hub.track[first:], is_whole
