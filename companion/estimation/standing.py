"""What speaks for and against an estimate: contact, agreement, contradictions, NIS, restarts."""

from __future__ import annotations

from companion.domain import RangingMeasurement
from companion.estimation.agreement import Agreement
from companion.estimation.base import Inflation, UpdateReport
from companion.estimation.contact import Contact
from companion.estimation.contradiction import Contradiction
from companion.estimation.divergence import NisWindow, RestartCounter
from companion.estimation.gate import OPEN, Gate
from companion.estimation.objections import Objection


class Standing:
    """Counts how measurements agree with the estimate that they meet."""

    def __init__(self) -> None:
        self.contact = Contact()
        """How old each kind of measurement is, and how many agreed since the last gap."""
        self._contradiction = Contradiction()
        self._agreement = Agreement()
        self._nis = NisWindow()
        self._restarts = RestartCounter()
        self._inflation_at_loss: Inflation | None = None
        """Shown when agreement was lost; None: it is not."""

    @property
    def is_proven(self) -> bool:
        """Whether the estimate has a say in which measurements are outliers."""
        return self._agreement.is_proven

    def judging(self, shown: Inflation) -> Inflation:
        """The inflation that measurements are judged by.

        Once next to nothing agrees, that itself inflates what the run shows, until everything would
        agree again with an estimate that nothing speaks for.

        Args:
            shown: Inflation of range, bearing and elevation that the run shows now.
        """
        if self._inflation_at_loss is None:
            return shown
        range_, bearing, elevation = map(min, shown, self._inflation_at_loss)
        return (range_, bearing, elevation)

    def began(self, measurement: RangingMeasurement) -> None:
        """Note the first measurement of an estimate, which agrees with everything."""
        self.contact = self.contact.after(measurement, OPEN)

    def note(
        self,
        measurement: RangingMeasurement,
        report: UpdateReport,
        gate: Gate,
        inflation: Inflation,
    ) -> bool:
        """Note how a measurement agrees; whether the estimate should be given up.

        Args:
            measurement: All that was measured.
            report: What all of it would do.
            gate: What of it is fused.
            inflation: That the run has shown, whether or not the filter was told.
        """
        inflation = self.judging(inflation)
        self.contact = self.contact.after(measurement, gate)
        self._agreement.add(measurement.measured_at_s, agrees=gate.agrees)
        self._contradiction = self._contradiction.after(report, inflation, gate)
        is_out_of_band = self._nis.add(report, inflation, measurement.measured_at_s)
        if not self._agreement.is_lost:
            self._inflation_at_loss = None
        elif self._inflation_at_loss is None:
            self._inflation_at_loss = inflation
        is_conclusive = self._contradiction.is_conclusive or self._agreement.is_hopeless
        return is_conclusive or is_out_of_band

    def given_up(self, time_s: float) -> None:
        """The estimate was started anew; what was counted against the old one is void."""
        self._restarts.add(time_s)
        self._acquit()

    def forget(self) -> None:
        """Forget the contact, too, because the frame may have moved."""
        self.contact = Contact()
        self._acquit()

    def objection(self, now_s: float) -> Objection | None:
        """The gravest of what speaks against flying on the estimate."""
        if self._restarts.is_too_many(now_s):
            return Objection.UNSTABLE
        return Objection.CONTRADICTED if self._agreement.is_lost else None

    def _acquit(self) -> None:
        self._contradiction = Contradiction()
        self._agreement.clear()
        self._nis.clear()
        self._inflation_at_loss = None
