"""What the guard did to setpoints, for the log and the operator, and not twenty times a second."""

from __future__ import annotations

from companion.guard.fence import Fence
from companion.guard.gate import GuardReason

SAID_EVERY_S = 30.0
"""The same reason is not told again sooner."""
LOGGED_EVERY_S = 1.0
SILENT = frozenset({GuardReason.LAGGING, GuardReason.CUT_OFF})
"""They come and go with every corner: for the log only."""


class GuardNews:
    """Remembers what was told."""

    def __init__(self) -> None:
        self._said_s: dict[GuardReason, float] = {}
        self._logged: tuple[GuardReason, ...] = ()
        self._logged_s: float | None = None

    def texts(self, reasons: tuple[GuardReason, ...], now_s: float) -> list[str]:
        """The reasons that the operator has not been told for a while, in words."""
        fresh = [
            reason
            for reason in reasons
            if reason not in SILENT
            and now_s - self._said_s.get(reason, now_s - SAID_EVERY_S) >= SAID_EVERY_S
        ]
        self._said_s.update(dict.fromkeys(fresh, now_s))
        return [f"guard: {reason.value}" for reason in fresh]

    def record(self, reasons: tuple[GuardReason, ...], now_s: float) -> list[str] | None:
        """The reasons for the log if they changed, and if that was not logged just now."""
        is_soon = self._logged_s is not None and now_s - self._logged_s < LOGGED_EVERY_S
        if reasons == self._logged or is_soon:
            return None
        self._logged, self._logged_s = reasons, now_s
        return [reason.name.lower() for reason in reasons]


class FenceNews:
    """Remembers which fence the log has."""

    def __init__(self) -> None:
        self._logged: Fence | None = None

    def record(self, fence: Fence | None) -> dict[str, object] | None:
        """The fence for the log if it is another one, null for none; None: it is the same."""
        if fence is self._logged or fence == self._logged:
            return None
        self._logged = fence
        return {
            "polygon_enu_m": None if fence is None else fence.polygon_enu_m,
            "keep_out_enu_m": () if fence is None else fence.keep_out_enu_m,
            "margin_m": None if fence is None else fence.margin_m,
        }
