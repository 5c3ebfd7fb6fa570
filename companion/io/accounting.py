"""What the process takes of its machine: memory, descriptors, threads, processor time.

Read from /proc where there is one, otherwise as far as the standard library tells.
"""

from __future__ import annotations

import os
import resource
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_STATM = Path("/proc/self/statm")
_DESCRIPTORS = Path("/proc/self/fd")


@dataclass(frozen=True, slots=True)
class ProcessUse:
    """What the process holds at a moment."""

    resident_mb: float
    """Memory in RAM now; the peak where the system does not tell."""
    descriptors: int | None
    """Open files and sockets; None where the system does not tell."""
    threads: int
    processor_s: float
    """User and system time since the start."""


def process_use() -> ProcessUse:
    """What this process holds now."""
    resident_mb = _peak_mb()
    descriptors = None
    with suppress(OSError, ValueError, IndexError):
        pages = int(_STATM.read_text().split()[1])
        resident_mb = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        descriptors = len(os.listdir(_DESCRIPTORS)) - 1  # without the one that lists them
    return ProcessUse(
        resident_mb=round(resident_mb, 3),
        descriptors=descriptors,
        threads=threading.active_count(),
        processor_s=round(time.process_time(), 3),
    )


def _peak_mb() -> float:
    """ru_maxrss, which macOS counts in bytes and Linux in kB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if os.uname().sysname == "Darwin" else peak / 1e3
