"""Updates the digests of the golden flights, after a change that is meant to change them.

    .venv/bin/python -m tools.update_golden [--fly] [NAME ...]

Replays the recorded flights and writes digests of their estimates and setpoints. A companion that
flies elsewhere than the recorded vehicle did soon holds or yields, so after a larger change --fly
flies them again first, which costs the repository two megabytes. Each flight that changes is
listed: commit `tests/data/golden` with the change that it shows.
"""

from __future__ import annotations

import os

os.environ["NUMBA_DISABLE_JIT"] = "1"  # as the tests: compiled kernels differ in the last digits

import argparse
import tempfile
from pathlib import Path

from companion.entry import ignore_broken_pipe
from tests.loop import golden_flights


def main() -> None:
    """Replay or fly the flights again, and write their digests."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "names", metavar="NAME", nargs="*", choices=[*golden_flights.PLANS, []], help="only these"
    )
    parser.add_argument("--fly", action="store_true", help="fly again instead of replaying")
    arguments = parser.parse_args()
    golden_flights.FOLDER.mkdir(parents=True, exist_ok=True)
    outputs = golden_flights.load_outputs() if golden_flights.OUTPUTS.exists() else {}
    for name in arguments.names or list(golden_flights.PLANS):
        path = golden_flights.FOLDER / f"{name}{golden_flights.SUFFIX}"
        if arguments.fly or not path.exists():
            with tempfile.TemporaryDirectory() as directory:
                golden_flights.save(
                    golden_flights.fly(golden_flights.PLANS[name], Path(directory)), path
                )
        before, now = (
            outputs.get(name),
            golden_flights.GoldenOutput.of(golden_flights.replayed(golden_flights.load(path))),
        )
        word = "as it was" if now == before else "new" if before is None else "CHANGED"
        outputs[name] = now
        size_kb = path.stat().st_size / 1000.0
        print(
            f"{name:<18} {word:<9} {now.estimates:>4} estimates {now.setpoints:>5} setpoints "
            f"{size_kb:6.1f} kB"
        )
    golden_flights.save_outputs(
        {name: outputs[name] for name in golden_flights.PLANS if name in outputs}
    )


if __name__ == "__main__":
    ignore_broken_pipe()
    main()
