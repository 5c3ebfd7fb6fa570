"""Each recipe of CONTRIBUTING.md as a newcomer would follow it: its steps as edits of files.

Every specimen is small but whole: it passes the contract of its kind and the tests of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

from tests.e2e.flight_recipes import FAILSAFE, FILTER, PLANNER
from tests.e2e.recipe_edits import Command, Edit, Steps

RADIO: Steps = {
    1: (
        Edit(
            "companion/radios/acme.py",
            '''"""Acme's radio: tag, millimetres and a checksum, as in `$ACM,7,12345*49`."""

from __future__ import annotations

import functools
import operator
import re

from companion.radios.decoder import LineDecoder, RadioReading

LINE = re.compile(r"\\$(ACM,([0-9]{1,5}),([0-9]{1,7}))\\*([0-9A-F]{2})")


class AcmeDecoder(LineDecoder):
    """Its lines."""

    has_stamps = False

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """One range."""
        found = LINE.fullmatch(line)
        if not found:
            self.counts.resync_bytes += len(line)
            return []
        body, tag, range_mm, checksum = found.groups()
        if functools.reduce(operator.xor, body.encode()) != int(checksum, 16):
            self.counts.bad_checksum += 1
            return []
        self.counts.frames += 1
        return [RadioReading(tag, range_m=int(range_mm) / 1000.0)]
''',
        ),
    ),
    2: (
        Edit(
            "companion/radios/kinds.yaml",
            "\nacme:\n  decoder: acme:AcmeDecoder\n  title: Acme Pinger\n  gives: range\n"
            "  emitter: an Acme tag\n  defaults: {range_sigma_m: 0.5}\n",
        ),
    ),
    3: (
        Edit(
            "tests/unit/companion/radios/test_acme.py",
            """from __future__ import annotations

import pytest

from companion.radios.acme import AcmeDecoder


@pytest.mark.parametrize(("line", "ranges_m"), [("$ACM,7,12345*49", [12.345]), ("$ACM,7*00", [])])
def test_a_line_of_the_manual_is_a_range(line: str, ranges_m: list[float]) -> None:
    found = AcmeDecoder().feed(f"{line}\\r\\n".encode(), 0.0)
    assert [reading.range_m for reading in found] == ranges_m
""",
        ),
    ),
    4: (
        Edit(
            "tests/data/radios/acme.bin",
            "$ACM,7,12345*49\r\n$ACM,8,980*46\r\n$ACM,7,12001*4A\r\n",
        ),
        Edit("tests/contract/radio_streams.py", '"acme", ', r"^CHECKSUMMED = \{"),
        Command(
            ("-m", "tests.contract.radio_streams", "acme"), makes="tests/data/radios/acme.jsonl"
        ),
    ),
    5: (
        Edit(
            "sim_link/emulators/acme.py",
            '''"""Acme's radio. Source: its manual, section "Output"."""

from __future__ import annotations

from sim_link.emulators.emulator import Answer, Emulator, Round, clamped, lines


class Acme(Emulator):
    """A line for each tag that answered."""

    name = "acme"
    title = "Acme Pinger"

    def encode(self, asked: Round) -> bytes:
        """In millimetres."""
        return lines([self._line(each) for each in asked.heard if each.range_m is not None])

    def _line(self, answer: Answer) -> str:
        range_mm = clamped(1000.0 * (answer.range_m or 0.0), 0, 9_999_999)
        body, check = f"ACM,{answer.emitter_id},{range_mm}", 0
        for byte in body.encode():
            check ^= byte
        return f"${body}*{check:02X}"
''',
        ),
        Edit(
            "sim_link/emulators/catalogue.py",
            "from sim_link.emulators import acme as acme_radio\n",
            r"^from companion.errors import .*\n",
        ),
        Edit("sim_link/emulators/catalogue.py", "    acme_radio,\n", r"^MODULES = \(\n"),
        Edit("tests/radio_formats.py", '    Format("acme", "acme", 0.5e-3),\n', r"^FORMATS = \(\n"),
    ),
    6: (
        Edit(
            "configs/radios/acme.yaml",
            "# Acme Pinger: ranges alone.\n\nradios:\n  - name: acme\n"
            "    url: serial:/dev/ttyUSB0:115200\n    settings:\n      range_offset_m: 0.0\n",
        ),
        Edit(
            "docs/radios.md",
            "| an Acme tag | [Acme](radios/uwb.md#acme) | `acme` | I | `phone_ftm` |\n",
            r"^\| a LoRa module .*\n",
        ),
        Edit("docs/radios/uwb.md", "\n## Acme\n\nPlug it in.\n"),
    ),
}

RULE: Steps = {
    1: (
        Edit(
            "sim_link/lab/conformance/vehicle_rules/telemetry_rules.py",
            '''
    @book.rule("MAVLink common, SYS_STATUS.load")
    def load_is_a_share(self) -> None:
        """SYS_STATUS.load is at most 1000, in tenths of a percent."""
        self.set_interval(mavlink.MAVLink_sys_status_message, 0.2)
        self.run(2.0)
        reports = [e.message for e in self.inbox if e.message.get_type() == "SYS_STATUS"]
        require(bool(reports), "SYS_STATUS did not come")
        require(max(vars(each)["load"] for each in reports) <= 1000, "more than all")
''',
            r"^class TelemetryRules(.*\n)+?    book = .*\n",
        ),
    ),
    2: (),
    3: (
        Edit(
            "tests/protocol/test_conformance_suite.py",
            '    "load_is_a_share broken": '
            '("telemetry.load_is_a_share", PX4, unchanged, set_byte(1, 13, 255)),\n',
            r"^DEFECTS: .* = \{\n",
        ),
    ),
}

STEP: Steps = {
    1: (
        Edit(
            "sim_link/lab/mission/script.py",
            '''class StandStep(StepParams, frozen=True):
    """Wait until the vehicle stands, disarmed, by whichever mode."""

    limit_s: Limit = 60.0


''',
            r"^class LandStep\((.*\n)+?\n\n",
        ),
        Edit(
            "sim_link/lab/mission/script.py",
            '"stand", ',
            r"^StepWord = Literal\[(.*\n)+?    (?=\"hold\")",
        ),
        Edit(
            "sim_link/lab/mission/script.py",
            "    stand: StandStep | UnsetType | None = UNSET\n",
            r"^    land: LandStep .*\n",
        ),
    ),
    2: (
        Edit(
            "sim_link/lab/mission/steps.py",
            '    script.StandStep: StepRule("standing, disarmed", DISARMED),\n',
            r"^FIXED_RULES: .* = \{\n",
        ),
    ),
    3: (
        Edit(
            "docs/missions.md",
            "| `stand` | Wait until the vehicle stands, disarmed. | `limit_s` (60.0) |\n",
            r"^\| `land` .*\n",
        ),
    ),
}

TEXT: Steps = {
    1: (
        Edit(
            "companion/link/quality.py",
            "        self._is_loose = False\n",
            r"^        self\._is_offset_said = False\n",
        ),
        Edit(
            "companion/link/quality.py",
            """        if self.stage.lost >= 3 and not self._is_loose:
            self._is_loose = True
            news.append((Severity.WARNING, f"lost {self.stage.lost} times: check its plug"))
""",
            r"^        news = \[\*self\._names.*\n",
        ),
    ),
    2: (
        Edit(
            "docs/messages.md",
            "| `lost … times: check its plug` | | plug it in |\n",
            r"^\| `heard again` .*\n",
        ),
    ),
    3: (
        Edit(
            "tests/unit/companion/link/test_radio_watch.py",
            """

def test_a_loose_plug_is_reported_once() -> None:
    watch = watch_of()
    for _ in range(3):
        watch.stage.receive(b"", 0.0)
    assert announced(watch, 0.0, 2.0) == ["radio said: lost 3 times: check its plug"]
""",
        ),
    ),
}

KEY: Steps = {
    1: (
        Edit(
            "companion/guidance/commands.py",
            '''    patience_s: Waiting = 60.0
    """Time without an operator's answer after which the search continues."""
''',
            r'^    """Search altitude above home\."""\n',
        ),
    ),
    2: (
        Edit(
            "configs/companion/default.yaml",
            "  patience_s: 60.0          # time without an answer until the search continues\n",
            r"^  altitude_m: .*\n",
        ),
        Edit(
            "docs/flying.md",
            "Without an answer for `mission.patience_s` the search continues.\n\n",
            r"^## Several emitters\n\n",
        ),
    ),
    3: (
        Edit(
            "companion/config/versions.py",
            """    mission = raw.get("mission")
    if isinstance(mission, dict) and "waits_s" in mission:
        mission["patience_s"] = mission.pop("waits_s")
""",
            r"^    emitter_id = raw\.pop.*\n",
        ),
        Edit(
            "tests/unit/companion/config/test_versions.py",
            """

def test_patience_s_had_another_name() -> None:
    raw = {"mission": {"waits_s": 5.0}}
    assert renew(raw, "site") == []
    assert raw == {"schema_version": SCHEMA_VERSION, "mission": {"patience_s": 5.0}}
""",
        ),
    ),
}


@dataclass(frozen=True, slots=True)
class Recipe:
    """A recipe of the page, and how it is followed."""

    heading: str
    name: str
    """Value of `NAME`; the tests that run must contain it."""
    steps: Steps
    mentions: frozenset[str] = frozenset()
    """Files that its steps name to be read, or for cases that the specimen is not."""


RECIPES = (
    Recipe("A filter", "gated", FILTER),
    Recipe("A planner, or a search pattern", "orbit", PLANNER),
    Recipe("A radio", "acme", RADIO),
    Recipe("A text for the operator", "loose", TEXT, frozenset({"companion/guidance"})),
    Recipe(
        "A configuration key",
        "patience_s",
        KEY,
        frozenset({"companion/config/schema.py", "tests/data/configs_1.0.0rc1.yaml"}),
    ),
    Recipe(
        "A failsafe",
        "vibration",
        FAILSAFE,
        frozenset({"companion/guidance/health/autopilot_health.py"}),
    ),
    Recipe(
        "A MAVLink rule",
        "load_is_a_share",
        RULE,
        frozenset(
            {
                "sim_link/lab/conformance/companion_rules.py",
                "sim_link/lab/conformance/autopilot_notes.yaml",
                "docs/conformance.md",
            }
        ),
    ),
    Recipe("A step of missions", "stand", STEP),
)
