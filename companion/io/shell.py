"""The one loop that drives any endpoint: its clock, links, one timer, signals.

Theory of operation. The loop wakes when a link has data or the endpoint's timer is due. A wake-up
hands over what arrived (at most 64 reads of one link), with the time of its arrival where the
system knows it and the current time otherwise, fires the timer if it is due, sends what the
endpoint has queued and calls `on_wakeup`. The timer is checked on every wake-up, so a flood of
datagrams cannot keep it waiting, and it fires once however late it is: the endpoint decides what to
skip.

An autopilot sends its messages in bursts, and a wake-up costs more than reading one of them,
because other programs have used the processor's caches since then. So a wake-up by data waits 2 ms
for the rest of its burst, unless the timer is due before. While `may_gather` allows it, data that
are stamped with their arrival wait for the timer: between two control ticks no setpoint is sent.

After a stall (the process was suspended or starved) the links hold what arrived during it. It is
read before the timer fires, so that the first tick works with current data; a flood can delay that
by 0.1 s only.

A stop (SIGINT, SIGTERM, SIGHUP or `request_stop`) asks the endpoint for an orderly end and gives it
1.5 wall seconds; a second signal ends at once. Two within 0.3 s count as one, also once the loop
has ended: timeout(1) and some supervisors signal the process and then its group. An exception out
of the endpoint is a bug of this program: it ends the loop and is raised, because a companion that
is silent is safe (the autopilot's own failsafe takes over) and one in an unknown state is not.
"""

from __future__ import annotations

import asyncio
import math
import select
import selectors
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeAlias

from companion.io.links.link import Link
from companion.io.links.transports import Transport, make_link
from companion.mav.endpoint import Chunk, Endpoint

if TYPE_CHECKING:
    from _typeshed import FileDescriptorLike


class Clock:
    """Monotonic seconds since it was started, times `speed`, which is positive and finite."""

    def __init__(self, speed: float = 1.0) -> None:
        if not (math.isfinite(speed) and speed > 0.0):
            raise ValueError(f"speed must be positive and finite, not {speed}")
        self.speed = speed
        self.restart()

    def restart(self) -> None:
        """Start again at zero."""
        self._started_s = time.monotonic()

    def now_s(self) -> float:
        """Return the seconds of this clock since it was started; never decreases."""
        return (time.monotonic() - self._started_s) * self.speed

    def delay_s(self, until_s: float) -> float:
        """Return the wall seconds until this clock shows `until_s`; 0 if it already does."""
        return max(0.0, (until_s - self.now_s()) / self.speed)


STOP_DEADLINE_S = 1.5
"""Wall seconds from the first stop request to the end, whatever the endpoint says; closing the logs
takes the rest of the two seconds that a stop may last."""
SAME_SIGNAL_S = 0.3
"""Wall seconds within which a second signal counts as the same request."""
LATE_S = 0.05
"""Lateness of a timer that has missed a whole control tick."""
STALL_S = 0.2
"""Lateness of a timer after which what the links hold is out of date."""
CATCH_UP_S = 0.1
"""Limit of wall-clock seconds for reading the links' backlog after a stall."""
MIN_TIMER_S = 0.001
"""Shortest wait, so that an endpoint that is always due does not take the whole processor."""
MAX_TIMER_S = 3600.0
"""Longest timer: the loop refuses timers of many days, and an hourly wake-up costs nothing."""

GATHER_S = 0.002
"""Wait for the rest of a burst: a cycle's messages arrive within 1 ms, cycles 4 to 20 ms apart."""

OnWakeup = Callable[[float], None]
SignalHandler: TypeAlias = "Callable[[int, FrameType | None], Any] | int | None"


_READ, _WRITE = selectors.EVENT_READ, selectors.EVENT_WRITE
_POLLED = {
    _READ: select.POLLIN,
    _WRITE: select.POLLOUT,
    _READ | _WRITE: select.POLLIN | select.POLLOUT,
}
"""Events of `select.poll`, by those of a selector."""


class GatheringSelector(selectors.DefaultSelector):
    """Selector that gathers data that may wait, but not after its timeout.

    Those of `stamped` descriptors wait for the timeout, or for data of another descriptor; any
    others wait for `GATHER_S`.
    """

    def __init__(self, stamped: Callable[[], Collection[int]] = tuple) -> None:
        super().__init__()
        self._stamped = stamped
        self._others: tuple[Collection[int], Callable[[float], object]] | None = None
        """Descriptors that may wait, and a wait, ms, for all others; None once these changed."""

    def register(
        self, fileobj: FileDescriptorLike, events: int, data: object = None
    ) -> selectors.SelectorKey:
        """Watch a descriptor."""
        self._others = None
        return super().register(fileobj, events, data)

    def modify(
        self, fileobj: FileDescriptorLike, events: int, data: object = None
    ) -> selectors.SelectorKey:
        """Watch a descriptor for other events."""
        self._others = None
        return super().modify(fileobj, events, data)

    def unregister(self, fileobj: FileDescriptorLike) -> selectors.SelectorKey:
        """Stop watching a descriptor."""
        self._others = None
        return super().unregister(fileobj)

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait for data, then for more of it; a timeout of 0 waits for nothing."""
        due_s = math.inf if timeout is None else time.monotonic() + timeout
        if timeout is not None and timeout > 0.0 and (stamped := self._stamped()):
            if self._others is None or self._others[0] != stamped:
                others = select.poll()
                for key in self.get_map().values():
                    if key.fd not in stamped:
                        others.register(key.fd, _POLLED[key.events])
                self._others = stamped, others.poll
            self._others[1](1e3 * timeout)
            return super().select(0.0)
        ready = super().select(timeout)
        left_s = due_s - time.monotonic()
        if ready and left_s > 0.0:
            time.sleep(min(GATHER_S, left_s))
        return ready


@dataclass(slots=True)
class TimerStatistics:
    """Lateness of the timer in wall seconds."""

    fired: int = 0
    late: int = 0
    """Number of firings later than `LATE_S`."""
    late_total_s: float = 0.0
    """Sum of those delays."""
    worst_late_s: float = 0.0
    stalls: int = 0
    """Number of firings later than `STALL_S`, after which the links were emptied first."""

    def note(self, late_s: float) -> None:
        """Record the lateness of one firing."""
        self.fired += 1
        self.worst_late_s = max(self.worst_late_s, late_s)
        if late_s > LATE_S:
            self.late += 1
            self.late_total_s += late_s


class Shell:
    """Runs one endpoint on its links; `on_wakeup` is called with the time after each wake-up.

    While `may_gather` returns True, stamped data wait for the endpoint's timer.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        links: Sequence[Transport],
        clock: Clock,
        on_wakeup: OnWakeup | None = None,
        may_gather: Callable[[], bool] | None = None,
    ) -> None:
        self._endpoint = endpoint
        self._clock = clock
        self._on_wakeup = on_wakeup
        self._may_gather = may_gather
        self.links: list[Link] = [
            make_link(spec, index, self._take) for index, spec in enumerate(links)
        ]
        self._arrived: list[Chunk] = []
        """Chunks that were read and not handed over yet."""
        self._handed_s = 0.0
        """Latest time passed to the endpoint."""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end: asyncio.Event | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._armed_s = math.inf
        """Time to which the endpoint's timer is set."""
        self._deadline: asyncio.TimerHandle | None = None
        self.timing = TimerStatistics()
        self._catching_up_until_s: float | None = None
        """Wall time until which the links are emptied after a stall."""
        self._is_drained = False
        """True if no link had data since the last check of the timer."""
        self._stop_wanted = threading.Event()
        self._is_stopping = False
        self._signalled_s: float | None = None
        """Monotonic time of the last signal that counted."""
        self._failure: BaseException | None = None

    async def run(self) -> None:
        """Drive the endpoint to its end; raises its exception, or a `LinkError` for a link."""
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        try:
            for link in self.links:
                await link.open()
            with self._signals(self._loop):
                if self._stop_wanted.is_set():
                    self._begin_stop()
                self._wake()
                await self._end.wait()
        finally:
            self._close()
        if self._failure is not None:
            raise self._failure

    def run_blocking(self) -> None:
        """Call `run` without an event loop; raises the same."""
        with asyncio.Runner(loop_factory=self._make_loop) as runner:
            runner.run(self.run())

    def run_whole(self) -> None:
        """Call `run_blocking`; raises KeyboardInterrupt if a signal cut it short."""
        self.run_blocking()
        if self._is_stopping:
            raise KeyboardInterrupt

    def request_stop(self) -> None:
        """Begin an orderly end; from any thread, before or during `run`, any number of times."""
        self._stop_wanted.set()
        loop = self._loop
        if loop is not None:
            with suppress(RuntimeError):  # the loop has ended: stopped anyway
                loop.call_soon_threadsafe(self._begin_stop)

    def _make_loop(self) -> asyncio.AbstractEventLoop:
        return asyncio.SelectorEventLoop(GatheringSelector(self._stamped_descriptors))

    def _stamped_descriptors(self) -> Collection[int]:
        """Return the descriptors whose data may wait for the timer now."""
        if self._timer is None or self._may_gather is None or not self._may_gather():
            return ()
        found = (link.stamped_descriptor for link in self.links)
        return [descriptor for descriptor in found if descriptor is not None]

    def _take(self, chunks: list[Chunk]) -> None:
        """Accept the chunks of a link; if the timer is due now, it delivers them."""
        self._arrived += chunks
        timer, loop = self._timer, self._loop
        if timer is None or loop is None or timer.when() - loop.time() > MIN_TIMER_S:
            self._wake()

    def _on_timer(self) -> None:
        self._timer = None
        self._wake()
        self._is_drained = True

    def _hand_over(self, now_s: float) -> None:
        """Deliver the chunks in order of arrival, with their times."""
        arrived, self._arrived = self._arrived, []
        if not arrived:
            return
        self._is_drained = False
        read_s, speed = time.monotonic(), self._clock.speed
        if len(self.links) > 1:  # one link hands over in the order of arrival
            arrived.sort(key=lambda each: read_s if each.arrived_s is None else each.arrived_s)
        for chunk in arrived:
            age_s = 0.0 if chunk.arrived_s is None else read_s - chunk.arrived_s
            self._handed_s = max(self._handed_s, now_s - age_s * speed)
            self._endpoint.receive(chunk, self._handed_s)

    def _wake(self, *, begins_stop: bool = False) -> None:
        if self._end is None or self._end.is_set():
            return
        now_s = self._clock.now_s()
        try:
            self._hand_over(now_s)
            self._handed_s = now_s
            if begins_stop:
                self._endpoint.request_stop(now_s)
            due_s = self._endpoint.next_timer_s()
            if due_s <= now_s and self._may_fire(due_s, now_s):
                self._endpoint.handle_timer(now_s)
            for chunk in self._endpoint.take_output():
                self.links[chunk.link].send(chunk)
            if self._on_wakeup is not None:
                self._on_wakeup(now_s)
            if self._endpoint.is_finished:
                self._end.set()
            else:
                self._arm_timer()
        except Exception as error:
            self._failure = error
            self._end.set()

    def _may_fire(self, due_s: float, now_s: float) -> bool:
        """Return True if the due timer may fire; after a stall the links come first."""
        late_s = 0.0 if math.isinf(due_s) else (now_s - due_s) / self._clock.speed
        if self._catching_up_until_s is None and late_s > STALL_S:
            self.timing.stalls += 1
            self._catching_up_until_s = time.monotonic() + CATCH_UP_S
            self._is_drained = False
        is_catching_up = self._catching_up_until_s is not None and not self._is_drained
        if is_catching_up and time.monotonic() < (self._catching_up_until_s or 0.0):
            return False
        self._catching_up_until_s = None
        self.timing.note(late_s)
        return True

    def _arm_timer(self) -> None:
        next_s = self._endpoint.next_timer_s()
        if self._timer is not None:
            if next_s == self._armed_s:
                return
            self._timer.cancel()
            self._timer = None
        self._armed_s = next_s
        if self._loop is None or math.isinf(next_s):
            return
        delay_s = min(max(MIN_TIMER_S, self._clock.delay_s(next_s)), MAX_TIMER_S)
        self._timer = self._loop.call_later(delay_s, self._on_timer)

    def _begin_stop(self) -> None:
        if self._is_stopping or self._loop is None or self._end is None:
            return
        self._is_stopping = True
        self._deadline = self._loop.call_later(STOP_DEADLINE_S, self._end.set)
        self._wake(begins_stop=True)

    def _on_signal(self) -> None:
        now_s = time.monotonic()
        if self._signalled_s is not None and now_s - self._signalled_s <= SAME_SIGNAL_S:
            return
        if self._is_stopping and self._end is not None:
            self._end.set()
        self._signalled_s = now_s
        self._begin_stop()

    @contextmanager
    def _signals(self, loop: asyncio.AbstractEventLoop) -> Iterator[None]:
        """Install the signal handlers for the run; only the main thread may have any."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {
            number: signal.getsignal(number)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        }
        if before[signal.SIGHUP] is signal.SIG_IGN:  # nohup: meant to outlive its terminal
            del before[signal.SIGHUP]
        for number in before:
            loop.add_signal_handler(number, self._on_signal)
        try:
            yield
        finally:
            for number, handler in before.items():
                loop.remove_signal_handler(number)
                signal.signal(number, self._without_echo(handler))

    def _without_echo(self, handler: SignalHandler) -> SignalHandler:
        """Return the handler for after the run, which ignores an echo of the same signal."""
        signalled_s = self._signalled_s
        if signalled_s is None:
            return handler

        def pass_on(number: int, _: object) -> None:
            if time.monotonic() - signalled_s > SAME_SIGNAL_S:
                signal.signal(number, handler)
                signal.raise_signal(number)

        return pass_on

    def _close(self) -> None:
        for handle in (self._timer, self._deadline):
            if handle is not None:
                handle.cancel()
        for link in self.links:
            link.close()
        self._loop = None
