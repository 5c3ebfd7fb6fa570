"""Lets faults happen to a flight in lockstep, each at its time.

Faults of link and content go to the flight's `FaultyLink`; those of vehicle and pilot become
incidents of the simulator; those of the process kill, start and suspend the companion; attackers
send from an address of their own, or, on a signed link, from the vehicle's.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from companion.domain import FlightMode
from companion.mav.codec import MavCodec
from companion.mav.dialect import POSITION_ONLY, mavlink
from companion.mav.endpoint import Address, Chunk
from sim_link.autopilot.incidents import (
    FaultRecord,
    IncidentRecord,
    OtherVehicle,
    PilotMode,
    VehicleFault,
)
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.faults.faulty_link import Attacker, FaultyLink
from sim_link.lab.lockstep.flight import VEHICLE_PEER, Flight
from sim_link.lab.lockstep.flight_harness import Operator
from sim_link.lab.lockstep.observer import Frame, Observer

ATTACKER_PEER: Address = ("127.0.0.1", 16000)
SENDER_PEER: Address = ("127.0.0.1", 17000)
ATTACK_PERIOD_S = 0.02
"""An attacker's frames come in groups this far apart."""


class Injector(Observer):
    """Applies a schedule to a flight; attackers that are spoofing have the vehicle's address."""

    def __init__(
        self, flight: Flight, link: FaultyLink, operator: Operator, *, is_spoofing: bool = False
    ) -> None:
        self._flight = flight
        self._link = link
        self._operator = operator
        self._attacker = Attacker(np.random.default_rng((flight.seed, 0xA77)))
        self._attack_peer = VEHICLE_PEER if is_spoofing else ATTACKER_PEER
        self._other = MavCodec(254, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        flight.observers.append(self)

    def inject(self, schedule: faults.Schedule) -> None:
        """Start the schedule now; faults that are not on the link yet are put there too."""
        for fault in schedule.faults:
            self.add(fault)

    def add(self, fault: FaultRecord) -> None:
        """Apply one fault, its times counted from now."""
        began_s = self._flight.now_s
        self._link.add(fault, began_s)
        start_s = began_s + fault.start_s
        match fault:
            case OtherVehicle():
                end_s = began_s + fault.end_s
                self._flight.at(start_s, partial(self._flight.bring_other, fault, end_s))
            case VehicleFault() | faults.ProcessFault():
                self._flight.at(start_s, partial(self._happen, fault))
            case faults.SecurityFault():
                self._flight.at(start_s, partial(self._attack, fault, began_s + fault.end_s, 0.0))

    def vehicle_sent(self, frame: Frame) -> None:
        """Let the attacker hear a frame of the vehicle."""
        self._attacker.overhear(frame.data)

    def _happen(self, fault: VehicleFault | faults.ProcessFault) -> None:
        flight = self._flight
        match fault:
            case faults.Disarm():
                self._operator.disarm()
            case faults.ModeFlap():
                self._flap(fault, flight.now_s + fault.duration_s, is_ours=True)
            case faults.SecondSender():
                self._send_other(fault, flight.now_s + fault.duration_s)
            case IncidentRecord():
                flight.apply_incident(fault)
            case faults.CompanionKilled():
                flight.kill_companion()
                flight.at(flight.now_s + fault.down_s, self._start_again)
            case faults.CompanionStalled():
                flight.suspend_companion(fault.duration_s)
            case faults.CompanionTerminated():
                flight.stop_companion()

    def _flap(self, fault: faults.ModeFlap, end_s: float, *, is_ours: bool) -> None:
        now_s = self._flight.now_s
        mode = fault.mode if is_ours else FlightMode.OFFBOARD
        self._flight.apply_incident(PilotMode(mode=mode))
        if now_s < end_s or is_ours:
            next_s = now_s + 0.5 * fault.period_s
            self._flight.at(next_s, partial(self._flap, fault, end_s, is_ours=not is_ours))

    def _send_other(self, fault: faults.SecondSender, end_s: float) -> None:
        flight = self._flight
        message = mavlink.MAVLink_set_position_target_local_ned_message(
            round(1e3 * flight.now_s),
            flight.scenario.system_id,
            1,
            mavlink.MAV_FRAME_LOCAL_NED,
            POSITION_ONLY,
            *(fault.north_m, fault.east_m, -fault.up_m),
            *[0.0] * 8,
        )
        flight.sim.receive(Chunk(0, self._other.encode(message), SENDER_PEER), flight.now_s)
        next_s = flight.now_s + 1.0 / fault.rate_hz
        if next_s < end_s:
            flight.at(next_s, partial(self._send_other, fault, end_s))

    def _start_again(self) -> None:
        if not self._flight.is_companion_up:
            self._flight.start_companion()

    def _attack(self, fault: faults.SecurityFault, end_s: float, owed: float) -> None:
        flight = self._flight
        owed += fault.rate_hz * ATTACK_PERIOD_S
        for _ in range(int(owed)):
            data = self._attacker.next(fault)
            if data is not None:
                flight.attack(Chunk(0, data, self._attack_peer))
        next_s = flight.now_s + ATTACK_PERIOD_S
        if next_s < end_s:
            flight.at(next_s, partial(self._attack, fault, end_s, owed - int(owed)))
