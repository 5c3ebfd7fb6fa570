"""Geometry, fences in force, signatures and sender trust, written for the monitor alone.

Nothing here is shared with the companion's guard and codec but the key, so that a mistake in one is
not repeated in the other. Points are east and north, metres.

The autopilot's fences are those of the frames that reached the companion. A fence is in force once
its last item has arrived: all items since the last MISSION_COUNT, in order. In the air every fence
of the flight remains in force, on the ground only the newest.

Source: MAVLink developer guide, "Mission Protocol"; MAVLink common, MAV_CMD_NAV_FENCE_*.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from companion.mav.dialect import mavlink
from companion.mav.signing import SigningKey
from sim_link.lab.observer import Frame

Point = tuple[float, float]
Corners = Sequence[Point]

SETPOINTS = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
        mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
    }
)
"""Messages that guide a vehicle."""

BORDER_M = 4.0
"""Distance from a border within which "here" may be moved inwards by the margin."""
INWARDS_M = 2.0 * BORDER_M
"""Longest such move, of a position in a corner, or in the notch of one."""


def _is_wound_around(corners: Corners, point: Point) -> bool:
    """Return True if the border's winding number around a point is not zero."""
    winding = 0
    north = point[1]
    a = corners[-1]
    for b in corners:
        if a[1] <= north:
            if b[1] > north and _side(a, b, point) > 0.0:
                winding += 1
        elif b[1] <= north and _side(a, b, point) < 0.0:
            winding -= 1
        a = b
    return winding != 0


def border_distance_m(corners: Corners, point: Point) -> float:
    """Return the distance of a point from a polygon's border, m."""
    least_m = math.inf
    start = corners[-1]
    for end in corners:
        distance_m = to_segment_m(start, end, point)
        if distance_m < least_m:
            least_m = distance_m
        start = end
    return least_m


def depth_m(fence: Corners, keep_outs: Sequence[Corners], point: Point) -> float:
    """Return a point's depth inside the fence and outside all keep-outs, m; negative: violated."""
    depth = _inside_m(fence, point)
    for keep_out in keep_outs:
        depth = min(depth, -_inside_m(keep_out, point))
    return depth


def _inside_m(corners: Corners, point: Point) -> float:
    """Return a point's depth inside a polygon, m; negative: outside."""
    away_m = border_distance_m(corners, point)
    return away_m if _is_wound_around(corners, point) else -away_m


def is_moved_inwards(depth_m: float, vehicle: Point, position: Point) -> bool:
    """Return True if a vehicle so deep inside, at a border or beyond it, may stay at `position`."""
    return depth_m < BORDER_M and math.dist(vehicle, position) <= INWARDS_M


def is_way_clear(fence: Corners, keep_outs: Sequence[Corners], start: Point, end: Point) -> bool:
    """Return True if the straight line between two points inside crosses no border."""
    return not any(
        _cross(start, end, corners[i - 1], corners[i])
        for corners in (fence, *keep_outs)
        for i in range(len(corners))
    )


def _side(a: Point, b: Point, p: Point) -> float:
    """Return a positive value if `p` is left of the line from `a` to `b`."""
    return (b[0] - a[0]) * (p[1] - a[1]) - (p[0] - a[0]) * (b[1] - a[1])


def to_segment_m(a: Point, b: Point, p: Point) -> float:
    """Return the distance of `p` from the straight line between `a` and `b`, m."""
    east, north = b[0] - a[0], b[1] - a[1]
    to_east, to_north = p[0] - a[0], p[1] - a[1]
    length2 = east * east + north * north
    if length2 > 0.0:
        share = (to_east * east + to_north * north) / length2
        if share >= 1.0:
            share = 1.0
        if share > 0.0:
            to_east -= share * east
            to_north -= share * north
    return math.hypot(to_east, to_north)


def _cross(a: Point, b: Point, c: Point, d: Point) -> bool:
    return _side(a, b, c) * _side(a, b, d) < 0.0 and _side(c, d, a) * _side(c, d, b) < 0.0


TAG, STAMP = 6, 6
MAGIC_V2, SIGNED_FLAG = 0xFD, 0x01


class Proof:
    """Follows the newest timestamp of every component, of those that were read.

    A frame that was dropped unread is still new when a copy of it arrives.
    """

    def __init__(self, key: SigningKey) -> None:
        self._secret = key.secret
        self._newest: dict[tuple[int, int], int] = {}
        self._before: tuple[tuple[int, int], int] | None = None
        """Sender of the last accepted frame, and its previous newest timestamp."""

    def accepts(self, frame: bytes) -> bool:
        """Return True if the frame is signed with the key and newer than all of its sender."""
        self._before = None
        if frame[0] != MAGIC_V2 or not frame[2] & SIGNED_FLAG:
            return False
        tag = hashlib.sha256(self._secret + frame[:-TAG]).digest()[:TAG]
        if tag != frame[-TAG:]:
            return False
        sender = (frame[5], frame[6])
        stamp = int.from_bytes(frame[-TAG - STAMP : -TAG], "little")
        newest = self._newest.get(sender, -1)
        if stamp <= newest:
            return False
        self._before = (sender, newest)
        self._newest[sender] = stamp
        return True

    def unreadable(self) -> None:
        """Handle an unreadable frame."""
        self._before = None

    def dropped(self) -> None:
        """Handle that the last frame was not read."""
        if self._before is not None:
            sender, newest = self._before
            self._newest[sender] = newest
            self._before = None


FOLLOWED = (mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA)
SILENCE_S = 3.0
"""Silence of one address after which the other one may be accepted, s."""
TICK_S = 0.05
"""Control period of the companion, which looks for a silence at its ticks, s."""
EARLY_S, LATE_S = 3.0, 10.0
"""Lead on the vehicle's clock, and lag behind it, above which a stamp is from another clock, s."""
SAME_CLOCK_S = 1.0
"""Agreement required of the clock of another address without a hardware id, s."""
YOUNG_S = 5.0
"""Excess of a restarted clock over the time since the vehicle was heard last, s."""
REACH_M, REACH_MPS = 10.0, 25.0
"""Largest distance from the last reported position: at once, and for each second since."""
STAMPED = (
    mavlink.MAVLink_local_position_ned_message
    | mavlink.MAVLink_attitude_message
    | mavlink.MAVLink_global_position_int_message
    | mavlink.MAVLink_system_time_message
)


@dataclass(frozen=True, slots=True)
class Followed:
    """Clock and position of the sender that is followed, as its accepted frames show them."""

    is_genuine: bool
    heard_s: float
    clock_s: float | None = None
    """Our time minus its stamps, by the promptest frame; None: none had a stamp yet."""
    stamped_s: float = 0.0
    position_ned_m: tuple[float, float, float] | None = None
    position_s: float = 0.0

    def goes_on(self, frame: Frame) -> bool:
        """Return True if the followed vehicle may have a frame's stamp and position by now."""
        if self.clock_s is None:
            return True
        stamp_s, position = _sign_of(frame)
        if stamp_s is None:
            return False
        is_of_clock = -EARLY_S <= frame.time_s - stamp_s - self.clock_s <= LATE_S
        return is_of_clock and (
            position is None
            or self.position_ned_m is None
            or math.dist(position, self.position_ned_m)
            <= REACH_M + REACH_MPS * (frame.time_s - self.position_s)
        )

    def has_clock_of(self, frame: Frame) -> bool:
        """Return True if a frame's stamp is from the very clock of the followed vehicle."""
        stamp_s, _ = _sign_of(frame)
        if stamp_s is None or self.clock_s is None:
            return True
        return abs(frame.time_s - stamp_s - self.clock_s) <= SAME_CLOCK_S

    def is_restart(self, frame: Frame) -> bool:
        """Return True if a frame may come from the followed vehicle after a restart."""
        stamp_s, _ = _sign_of(frame)
        return stamp_s is not None and stamp_s <= frame.time_s - self.stamped_s + YOUNG_S

    def with_frame(self, frame: Frame) -> Followed:
        """Process an accepted frame; a stranger's that contradicts the course is left out."""
        now_s = frame.time_s
        stamp_s, position = _sign_of(frame)
        heard = replace(self, is_genuine=frame.is_genuine, heard_s=now_s)
        if stamp_s is None:
            return heard
        clock_s = now_s - stamp_s
        if not self.goes_on(frame):
            if not frame.is_genuine:
                return heard
            return Followed(True, now_s, clock_s, now_s, position, now_s)
        if self.clock_s is not None:
            drift_s = 0.1 * (now_s - self.stamped_s)
            clock_s = min(clock_s, self.clock_s + drift_s)
        heard = replace(heard, clock_s=clock_s, stamped_s=now_s)
        return (
            heard if position is None else replace(heard, position_ned_m=position, position_s=now_s)
        )


def _sign_of(frame: Frame) -> tuple[float | None, tuple[float, float, float] | None]:
    """Return the boot time, s, and NED position in a frame; None for each that it lacks."""
    message, position = frame.message, None
    if not isinstance(message, STAMPED) or not message.time_boot_ms:
        return None, None
    if isinstance(message, mavlink.MAVLink_local_position_ned_message):
        position = (message.x, message.y, message.z)
        position = position if all(map(math.isfinite, position)) else None
    return message.time_boot_ms / 1e3, position


class SenderTrust:
    """Follows one of several senders: the vehicle itself, another with its ids, or a stranger.

    Only the configured system id, if there is one, is followed. Another address with the same ids
    is accepted after a silence, from the first frame on whose stamp and position continue its own.
    It has to answer the hardware id, if one is known, or else to have the same clock. The silence
    lasts to the control tick before the frame: in a stall the vehicle's frames wait, too.
    """

    def __init__(self, wanted_system_id: int | None = None) -> None:
        self._wanted_system_id = wanted_system_id
        self._ids: tuple[int, int] | None = None
        """Ids of the autopilot that is followed; None: none yet."""
        self._followed: Followed | None = None
        self._before: Followed | None = None
        """Peer that was followed before the last frame."""
        self.ticked_s: float | None = None
        """Time of the companion's last control tick; None: not known."""
        self._hardware: dict[bool, int] = {}
        """Hardware id that the vehicle (True) and strangers (False) answered last."""
        self.is_unclear = False
        """True if the vehicle sends again with its own clock, but not from where the stranger that
        was followed reported to be, or within a tick of the silence: the companion may follow
        either."""

    @property
    def follows_unknown_peer(self) -> bool:
        """Return True if a sender other than the vehicle is followed."""
        return self._followed is not None and not self._followed.is_genuine

    def has_silent_vehicle(self, now_s: float) -> bool:
        """Return True if the followed sender was not heard for `SILENCE_S`."""
        return self._followed is not None and now_s - self._followed.heard_s >= SILENCE_S

    def is_beside_unknown_peer(self, frame: Frame) -> bool:
        """Return True if a frame's ids are those of a payload of the followed unknown peer."""
        is_of_it = self._ids is not None and frame.sender[0] == self._ids[0]
        return self.follows_unknown_peer and is_of_it

    def _may_follow(self, frame: Frame) -> bool:
        message = frame.message
        if not isinstance(message, mavlink.MAVLink_heartbeat_message):
            return False
        is_wanted = self._wanted_system_id in (None, frame.sender[0])
        return is_wanted and message.autopilot in FOLLOWED

    def restart(self) -> None:
        """Follow the first autopilot that a restarted companion hears."""
        self._ids = self._followed = self._before = self.ticked_s = None
        self._hardware.clear()

    def _is_possible(self, followed: Followed, frame: Frame) -> bool:
        """Return True if a frame of another address may be from the followed vehicle."""
        if followed.is_restart(frame):
            is_of_clock = True
        else:
            is_of_clock = followed.goes_on(frame) and (
                bool(self._hardware) or followed.has_clock_of(frame)
            )
        known = self._hardware.get(followed.is_genuine)
        return is_of_clock and known in (None, self._hardware.get(frame.is_genuine))

    def accepts(self, frame: Frame) -> bool:
        """Return True if a readable frame of an autopilot had to be accepted."""
        followed = self._before = self._followed
        if self._ids is None or followed is None:
            if not self._may_follow(frame):
                return frame.is_genuine
            self._ids = frame.sender
            followed = Followed(frame.is_genuine, frame.time_s)
        if frame.sender != self._ids:
            return False
        message = frame.message
        if isinstance(message, mavlink.MAVLink_autopilot_version_message) and message.uid:
            self._hardware[frame.is_genuine] = message.uid
        if frame.is_genuine is not followed.is_genuine:
            until_s = frame.time_s if self.ticked_s is None else self.ticked_s
            silent_s = until_s - followed.heard_s
            is_silent = silent_s >= SILENCE_S
            if not is_silent or not self._is_possible(followed, frame):
                is_stamped = isinstance(message, STAMPED) and followed.has_clock_of(frame)
                is_back = frame.is_genuine and silent_s >= SILENCE_S - TICK_S
                self.is_unclear = is_back and (self.is_unclear or is_stamped)
                return False
        self.is_unclear = False
        self._followed = followed.with_frame(frame)
        return True

    def dropped(self) -> None:
        """Handle that the last frame was not read."""
        if self._before is not None:
            self._followed = self._before


FENCE = mavlink.MAV_MISSION_TYPE_FENCE
POLYGON_IN = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
POLYGON_OUT = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
CIRCLE_IN = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION
CIRCLE_OUT = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION

Item = mavlink.MAVLink_mission_item_int_message
ToEnu = Callable[[float, float], Point]
"""Latitude and longitude in degrees to east and north in the world's frame."""


@dataclass(frozen=True, slots=True)
class FlownFence:
    """One fence: inside any of its inclusions, outside of all its exclusions."""

    inclusions: tuple[Corners, ...] = ()
    exclusions: tuple[Corners, ...] = ()
    circles_in: tuple[tuple[Point, float], ...] = ()
    circles_out: tuple[tuple[Point, float], ...] = ()

    def depth_m(self, position: Point) -> float:
        """Return the depth of a position inside the allowed area, m; negative: violated."""
        inside = [depth_m(each, (), position) for each in self.inclusions]
        inside += [radius_m - math.dist(at, position) for at, radius_m in self.circles_in]
        outside = [-depth_m(each, (), position) for each in self.exclusions]
        outside += [math.dist(at, position) - radius_m for at, radius_m in self.circles_out]
        return min([max(inside, default=math.inf), *outside])

    def is_way_clear(self, start: Point, end: Point) -> bool:
        """Return True if the straight line between two allowed points crosses no border."""
        polygons = (*self.inclusions, *self.exclusions)
        if polygons and not is_way_clear(polygons[0], polygons[1:], start, end):
            return False
        return all(to_segment_m(start, end, at) >= radius_m for at, radius_m in self.circles_out)


@dataclass(slots=True)
class FencesInForce:
    """The fences that hold besides that of the configuration, and the one that is being read."""

    fences: list[tuple[float, FlownFence]] = field(default_factory=list)
    """Each with the time when it was complete, in the order of that; equal ones once."""
    read_s: float = -math.inf
    """Time of the last complete download of a fence, or of its absence."""
    _count: int | None = None
    _items: list[Item] = field(default_factory=list)

    def clear(self) -> None:
        """Forget all fences: another process knows none yet."""
        self.fences.clear()
        self.read_s, self._count = -math.inf, None

    def land(self) -> None:
        """Keep only the newest fence, which alone counts on the ground."""
        del self.fences[:-1]

    def take(self, frame: Frame, to_enu: ToEnu) -> None:
        """Process a frame of the autopilot that reached the companion."""
        message = frame.message
        match message:
            case mavlink.MAVLink_mission_count_message() if message.mission_type == FENCE:
                self._count, self._items = message.count, []
            case mavlink.MAVLink_mission_item_int_message() if message.mission_type == FENCE:
                if self._count is not None and message.seq == len(self._items):
                    self._items.append(message)
            case _:
                return
        if self._count is not None and len(self._items) == self._count:
            self._count, self.read_s = None, frame.time_s
            fence = _fence_of(self._items, to_enu)
            if self._items and fence not in [each for _, each in self.fences]:
                self.fences.append((frame.time_s, fence))

    def known(self, before_s: float) -> list[FlownFence]:
        """Return the fences that were complete before a time."""
        return [fence for time_s, fence in self.fences if time_s < before_s]


def _fence_of(items: Sequence[Item], to_enu: ToEnu) -> FlownFence:
    """Return the fence that items make; those of a polygon follow each other."""
    polygons: dict[int, list[Corners]] = {POLYGON_IN: [], POLYGON_OUT: []}
    circles: dict[int, list[tuple[Point, float]]] = {CIRCLE_IN: [], CIRCLE_OUT: []}
    index = 0
    while index < len(items):
        item, count = items[index], 1
        if item.command in circles:
            at = to_enu(item.x / 1e7, item.y / 1e7)
            circles[item.command].append((at, item.param1))
        elif item.command in polygons:
            count = max(1, int(item.param1))
            corners = [to_enu(v.x / 1e7, v.y / 1e7) for v in items[index : index + count]]
            polygons[item.command].append(tuple(corners))
        index += count
    return FlownFence(
        tuple(polygons[POLYGON_IN]),
        tuple(polygons[POLYGON_OUT]),
        tuple(circles[CIRCLE_IN]),
        tuple(circles[CIRCLE_OUT]),
    )
