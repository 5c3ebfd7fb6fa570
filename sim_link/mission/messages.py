"""MAVLink messages by their names, as scripts call them."""

from __future__ import annotations

from functools import lru_cache

from companion.mav.dialect import mavlink


@lru_cache(maxsize=1)
def numbers_by_name() -> dict[str, int]:
    """The message ids of the dialect, our own messages included."""
    return {str(kind.msgname): int(number) for number, kind in mavlink.mavlink_map.items()}
