"""The map as a page element; what it draws is in `search_map.js`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nicegui
from nicegui.element import Element

LEAFLET = Path(nicegui.__file__).parent / "elements" / "leaflet" / "dist"


class SearchMap(Element, component="search_map.js", esm={"nicegui-leaflet": str(LEAFLET)}):
    """Leaflet on a grid in metres, or on tiles from a folder.

    Args:
        scene: What does not change during the flight.
        has_tiles: Whether `/tiles` has any.
    """

    def __init__(self, scene: Mapping[str, Any], *, has_tiles: bool) -> None:
        super().__init__()
        self.add_resource(LEAFLET)
        self._props["scene"] = dict(scene)
        self._props["hasTiles"] = has_tiles

    def show(self, picture: Mapping[str, Any], track: list[tuple[float, float]]) -> None:
        """Draw a moment.

        Args:
            picture: See `companion.view.picture`.
            track: Where the vehicle was.
        """
        self.run_method("show", dict(picture), track)
