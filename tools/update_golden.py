"""Flies the golden flights anew, after a change that is meant to change what is flown.

    .venv/bin/python -m tools.update_golden [NAME ...]

Each file that changes says so; commit them with the change that they show.
"""

from __future__ import annotations

import os

os.environ["NUMBA_DISABLE_JIT"] = "1"  # as the tests: compiled kernels differ in the last digits

import argparse
import tempfile
from pathlib import Path

from tests.loop.golden_flights import FOLDER, PLANS, SUFFIX, fly, load, save


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", metavar="NAME", nargs="*", choices=[*PLANS, []], help="only these")
    names = parser.parse_args().names or list(PLANS)
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in names:
        path = FOLDER / f"{name}{SUFFIX}"
        with tempfile.TemporaryDirectory() as directory:
            golden = fly(PLANS[name], Path(directory))
        before = load(path) if path.exists() else None
        digests = (golden.estimates_digest, golden.setpoints_digest)
        is_same = before is not None and digests == (
            before.estimates_digest,
            before.setpoints_digest,
        )
        if not is_same:
            save(golden, path)
        word = "as it was" if is_same else "new" if before is None else "CHANGED"
        size_kb = path.stat().st_size / 1000.0
        print(
            f"{name:<18} {word:<9} {golden.estimates:>4} estimates {golden.setpoints:>5} setpoints "
            f"{size_kb:6.1f} kB"
        )


if __name__ == "__main__":
    main()
