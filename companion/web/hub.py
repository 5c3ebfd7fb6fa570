"""What the page knows: the latest picture, the track and the curves; bounded for any flight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

TRACK_POINTS = 1000
TRACK_STEP_M = 0.5
CURVE_POINTS = 600


class Hub:
    """Takes pictures in; pages read it.

    Args:
        scene: What does not change.
    """

    def __init__(self, scene: Mapping[str, Any]) -> None:
        self.scene = scene
        self.picture: dict[str, Any] = {}
        self.version = 0
        """Grows with every picture."""
        self.track: list[tuple[float, float]] = []
        self.track_version = 0
        """Grows when the track does not merely go on: pages draw it anew then."""
        self.curve: list[dict[str, Any]] = []
        self._origin: object = None

    def take(self, picture: dict[str, Any]) -> None:
        """Take in a picture."""
        if picture.get("t_s", 0.0) < self.picture.get("t_s", 0.0):
            self._forget()  # the companion was started anew
        if picture.get("origin") != self._origin:
            self._origin = picture.get("origin")
            self.track, self.track_version = [], self.track_version + 1
        self._extend_track(picture.get("vehicle"))
        self.curve += picture.pop("curve", [])
        if len(self.curve) > CURVE_POINTS:
            self.curve = self.curve[::2]
        self.picture = picture
        self.version += 1

    def _forget(self) -> None:
        self.curve, self.track = [], []
        self.track_version += 1

    def _extend_track(self, place: object) -> None:
        if not isinstance(place, list) or len(place) < 2:
            return
        point = (float(place[0]), float(place[1]))
        if self.track and math.dist(point, self.track[-1]) < TRACK_STEP_M:
            return
        self.track.append(point)
        if len(self.track) > TRACK_POINTS:
            self.track = self.track[::2]
            self.track_version += 1
