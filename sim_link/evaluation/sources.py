"""A short name for everything that makes a study's numbers, so that old ones are never reused."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from functools import lru_cache
from pathlib import Path

from companion.kernel import IS_COMPILED

ROOT = Path(__file__).resolve().parents[2]
MAKING_NUMBERS = (
    "companion/domain.py",
    "companion/errors.py",
    "companion/estimation",
    "companion/geometry",
    "companion/kernel.py",
    "companion/models",
    "companion/params.py",
    "companion/planning",
    "sim_link/evaluation",
    "sim_link/world",
)
"""What a run comes to follows from these alone."""
ABOUT_NUMBERS = tuple(
    f"sim_link/evaluation/{name}"
    for name in (
        "backends.py",
        "cluster.py",
        "bench.py",
        "costs.py",
        "hostile.py",
        "planner_bench.py",
        "retrace.py",
        "progress.py",
        "reporting/",
        "results.py",
        "rows.py",
        "sources.py",
        "store.py",
        "study.py",
        "study_files.py",
        "study_run.py",
        "verification.py",
    )
)
"""Except these, which plan runs and report them."""
LIBRARIES = ("numpy", "scipy", "numba", "filterpy")
"""Another version of these may round differently."""


@lru_cache(maxsize=1)
def sources_digest() -> str:
    """The digest of sources and versions, the same on every machine that has the same."""
    digest = hashlib.sha256(f"{platform.python_version()} compiled {IS_COMPILED}\n".encode())
    for name in LIBRARIES:
        digest.update(f"{name} {version_of(name)}\n".encode())
    for path in sources():
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\n" + path.read_bytes())
    return digest.hexdigest()[:16]


def sources() -> list[Path]:
    """The files that a run's numbers follow from, in order."""
    found: set[Path] = set()
    for name in MAKING_NUMBERS:
        found.update([ROOT / name] if name.endswith(".py") else (ROOT / name).rglob("*.py"))
    return sorted(
        path for path in found if not path.relative_to(ROOT).as_posix().startswith(ABOUT_NUMBERS)
    )


def version_of(library: str) -> str:
    """The installed version of a library, or "none"."""
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return "none"
