"""Observed behaviour of real autopilots, as rows that tests play.

`observed.yaml` next to each flavour has the rows. A row describes the real vehicle's behaviour, and
has either `steps`, which `test_observed.py` plays against the flavour, a test of its own
(`proved_by`), or `deliberate`: the reason why the simulator differs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

ROOT = Path(__file__).resolve().parents[2]
FLAVOURS = ("px4", "ardupilot")
Fields = dict[str, Any]
"""By name. Expected: a number (NaN too), `[least, greatest]`, the name of a MAVLink constant, or
for text a regular expression for all of it. Sent: a number, a list, a text or such a name."""
Messages = dict[str, Fields]
"""Messages by MAVLink name."""


class Step(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One action, a waiting time, and the conditions that must then hold; in this order."""

    state: str | None = None
    """Another state's steps first."""
    link: str | None = None
    """Link on which it is done and observed; None: the row's."""
    seen_on: str | None = None
    """Another link on which it is seen."""
    client: int = 1
    """Number of the client on that link."""
    sender: tuple[int, int] = (255, 190)
    """System and component."""
    of: tuple[int, int] = (1, 1)
    """System and component whose messages are examined."""
    incident: Fields | None = None
    """Incident as in a scenario; it happens at once."""
    command: str | None = None
    """COMMAND_LONG, or COMMAND_INT with a `frame`: MAV_CMD without that prefix."""
    params: tuple[float, ...] = ()
    """The first ones; the rest are NaN, or 0 in COMMAND_INT's x and y."""
    frame: str | None = None
    """MAV_FRAME without that prefix."""
    target: tuple[int, int] = (1, 1)
    ack: str | None = None
    """The result without MAV_RESULT; `none`: silence."""
    send: Messages | None = None
    """Fields that are not given are 0, targets 1."""
    stream: Messages | None = None
    """Sent from now on until there is another one; `{}` ends it."""
    rate_hz: float = 20.0
    wait_s: float = 0.0
    expect: Messages | None = None
    """Each comes, since the step began or soon."""
    none: Messages | None = None
    """None of it comes."""
    within_s: float = 2.0
    """Deadline or duration, in s."""
    times: dict[str, int] | None = None
    """Number of each message since the step began."""
    rates_hz: dict[str, float] | None = None
    """Rates of messages over ten seconds, within 5 % and one message."""
    mode: str | None = None
    """`FlightMode` now."""
    armed: bool | None = None
    place: dict[str, float] | None = None
    """Metres: any of `north`, `east`, `up`, from the origin, within `within_m`."""
    within_m: float = 0.5


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One behaviour of the real vehicle."""

    id: str
    topic: str
    real: str
    state: str = "ready"
    link: str = "onboard"
    scenario: Fields = {}
    parameters: dict[str, float] = {}
    steps: tuple[Step, ...] = ()
    proved_by: str = ""
    """A test, `path::name`, for what takes processes or files."""
    deliberate: str = ""
    """Deliberate difference of the simulator, with its reason."""

    def __post_init__(self) -> None:
        """Refuse a row that proves nothing, or has two proofs."""
        if sum(map(bool, (self.steps, self.proved_by, self.deliberate))) != 1:
            raise ValueError(f"{self.id}: needs one of steps, proved_by and deliberate")


class Sheet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All rows about one autopilot."""

    firmware: str
    states: dict[str, tuple[Step, ...]]
    """Steps that bring a vehicle that was just switched on into each state."""
    rows: tuple[Row, ...]


def load_sheet(flavour: str) -> Sheet:
    """Return the sheet of a flavour; a `msgspec.ValidationError` names the error in it."""
    path = ROOT / "sim_link" / "autopilot" / flavour / "observed.yaml"
    return msgspec.yaml.decode(path.read_bytes(), type=Sheet)
