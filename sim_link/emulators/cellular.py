"""Cells on board that report the timing advance: srsRAN 4G, srsRAN Project, OAI.

The timing advance is the round-trip time, in steps that are cut off downwards where the random
access channel measures it: 16 Ts (78.07 m) in LTE, half of that in NR at 30 kHz. A phone is
identified by the temporary identity of its attachment.

Sources: 3GPP TS 36.213 4.2.3 and TS 38.213 4.2; the logs' formats as srsRAN_4G, srsRAN Project and
OpenAirInterface print them.
"""

from __future__ import annotations

import json

from sim_link.emulators.emulator import (
    LIGHT_MPS,
    Answer,
    Emulator,
    LineEmulator,
    Round,
    clamped,
    lines,
)
from sim_link.emulators.wifi import SIMULATION_BEGAN_S, round_trip_s

LTE_STEP_M = 0.5 * LIGHT_MPS * 16.0 / (15_000.0 * 2048.0)
NR_STEP_M = 0.5 * LTE_STEP_M
"""Step at a subcarrier spacing of 30 kHz."""
FIRST_CRNTI = 0x46
FIRST_RNTI = 17_921
FRAMES, SUBFRAMES = 1024, 10
"""Number after which the counters wrap: 10.24 s."""
PREAMBLES = 64


def steps_of(range_m: float, step_m: float) -> int:
    """Return whole steps of the timing advance; never negative."""
    return max(0, int(range_m // step_m))


def rach_line(tti: int, preamble: int, offset: int, crnti: int) -> str:
    """Return the console and MAC log of srsRAN 4G."""
    return (
        f"RACH:  tti={tti}, cc=0, pci=1, preamble={preamble}, offset={offset}, "
        f"temp_crnti=0x{crnti:x}"
    )


class Srsran4g(LineEmulator):
    """An LTE cell: a line whenever a phone is made to attach."""

    name = "srsran_4g"
    title = "srsRAN 4G, RACH lines"
    rate_hz = 2.0
    ids = range((1 << 16) - FIRST_CRNTI)

    def boot(self) -> bytes:
        """Return the log of a cell that starts."""
        return lines(["", "==== eNodeB started ===", "Type <t> to view trace"])

    def lines_of(self, answer: Answer, asked: Round) -> list[str]:
        """Return that its random access was heard, and that it is connected."""
        if answer.range_m is None:
            return []
        tti = self.device_ms(asked.sent_at_s) % (FRAMES * SUBFRAMES)
        offset, crnti = steps_of(answer.range_m, LTE_STEP_M), crnti_of(answer.emitter_id)
        preamble = int(self._rng.integers(PREAMBLES))
        return [rach_line(tti, preamble, offset, crnti), f"User 0x{crnti:x} connected"]

    @classmethod
    def name_on_wire(cls, emitter_id: int) -> str:
        """Return the temporary identity."""
        return f"0x{crnti_of(emitter_id):x}"


def crnti_of(emitter_id: int) -> int:
    """Return the temporary identity, counted up from srsRAN's first."""
    return FIRST_CRNTI + emitter_id


class Srsran(Emulator):
    """An NR cell whose timing advance loop is off, so that what is left over is all of it."""

    name = "srsran"
    title = "srsRAN Project, metrics of the remote control"
    rate_hz = 1.0
    ids = range((1 << 16) - FIRST_RNTI)
    epoch_s = SIMULATION_BEGAN_S

    def encode(self, asked: Round) -> bytes:
        """Return a report with all phones; a timing advance of 0.0 was not observed."""
        ues = [self._ue(number, answer) for number, answer in enumerate(asked.answers)]
        cell = {"cell_metrics": {"pci": 1}, "ue_list": ues}
        report = {"timestamp": round(self.device_s(asked.sent_at_s), 3), "cells": [cell]}
        return (json.dumps(report, separators=(",", ":")) + "\n").encode()

    def _ue(self, number: int, answer: Answer) -> dict[str, object]:
        ta_ns = 0.0 if answer.range_m is None else round(1e9 * round_trip_s(answer.range_m), 1)
        return {"ue": number, "pci": 1, "rnti": FIRST_RNTI + answer.emitter_id, "ta_ns": ta_ns}

    @classmethod
    def name_on_wire(cls, emitter_id: int) -> str:
        """Return the temporary identity."""
        return str(FIRST_RNTI + emitter_id)


class Oai(LineEmulator):
    """An NR cell at 30 kHz: two lines for each random access, which name no phone.

    The second one, of 2024 and later, has the distance; steps are rounded to the nearest.
    """

    name = "oai"
    title = "OpenAirInterface gNB, RAPROC lines"
    names = ""
    rate_hz = 2.0
    most = 1

    def lines_of(self, answer: Answer, asked: Round) -> list[str]:
        """Return both lines of a phone that was heard."""
        if answer.range_m is None:
            return []
        subframe = self.device_ms(asked.sent_at_s) % (FRAMES * SUBFRAMES)
        when = f"{subframe // SUBFRAMES}.{2 * (subframe % SUBFRAMES) + 1}"
        delay = max(0, round(answer.range_m / NR_STEP_M))
        preamble = int(self._rng.integers(PREAMBLES))
        energy = clamped(10.0 * (answer.power_dbm + 120.0), 1, 999)
        return [raproc_line(when, preamble, energy, delay), msg2_line(when, preamble, delay)]


def raproc_line(when: str, preamble: int, energy_tenths: int, delay: int) -> str:
    """Return the MAC log of the gNB."""
    energy = f"{energy_tenths // 10}.{energy_tenths % 10}"
    return (
        f"[RAPROC] {when} Initiating RA procedure with preamble {preamble}, energy {energy} dB "
        f"(I0 120, thres 120), delay {delay} start symbol 0 freq index 0"
    )


def msg2_line(when: str, preamble: int, delay: int) -> str:
    """Return the MAC log of a gNB of 2024 and later; its metres are those of 3e8 m/s."""
    distance_m = 3e8 / 2.0 * 16.0 / 30.72e6 / 2.0 * delay
    return (
        f"[NR_MAC] UE 4f1c: {when} Generating RA-Msg2 DCI, RA RNTI 0x10b, state 1, CoreSetType 0, "
        f"RAPID {preamble}, timing_offset = {delay} (estimated distance {distance_m:.1f} [m])"
    )
