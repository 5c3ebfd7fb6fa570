"""Mutants of the guard: every small change to its source must make one of its tests fail.

    .venv/bin/python -m tools.fuzz.mutate_guard [--json FILE] [--only TEXT] [PATH ...]

PATH is a module or a folder (default: companion/guard), for example companion/mav/codec.py; its
tests are those of the same place under tests/unit. Each mutant runs in a forked process that loads
the changed source instead of the file, so nothing on disk changes. Exit code 0: every mutant was
killed, or is listed in mutate_guard_equivalents.txt beside this file with a reason; 1: one
survived; 2: bad arguments, or tests that fail without any change.
"""

from __future__ import annotations

import ast
import importlib
import importlib.abc
import importlib.machinery
import os
import resource
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType

from companion.entry import ignore_broken_pipe
from companion.errors import CompanionError, ConfigError
from companion.io.files import write_json_atomic
from tools.console import OneLineParser, positive
from tools.fuzz.mutants import Mutant, mutants_of

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENTS = Path(__file__).with_name("mutate_guard_equivalents.txt")
MOST_EQUIVALENTS = 3
TIMEOUT_S = 120.0
"""Timeout of processor time, so that no process is killed because the machine is busy."""
MEMORY_BYTES = 4 << 30
PROFILE = "first-example-will-do"
PYTEST = (
    *("-x", "-q", "--no-header", "-p", "no:cacheprovider"),
    *("--hypothesis-seed=0", f"--hypothesis-profile={PROFILE}"),
    # pytest's rewriter precedes this finder and would load the unchanged file.
    "--assert=plain",
)


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finder that loads one module from a changed tree."""

    def __init__(self, module: str, tree: ast.Module, path: str) -> None:
        self._module = module
        self._code = compile(tree, path, "exec")

    def find_spec(
        self, fullname: str, path: object = None, target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Take over the import of the one module."""
        del path, target
        if fullname != self._module:
            return None
        return importlib.machinery.ModuleSpec(fullname, self)

    def exec_module(self, module: ModuleType) -> None:
        """Run the mutant in its place."""
        exec(self._code, module.__dict__)


def start(tests: Sequence[str], module: str = "", tree: ast.Module | None = None) -> int:
    """Fork a process that runs the tests; return its id. It exits with pytest's code."""
    pid = os.fork()
    if pid:
        return pid
    try:
        signal.setitimer(signal.ITIMER_PROF, TIMEOUT_S)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        null = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(null, descriptor)
        if tree is not None:
            sys.meta_path.insert(0, _Finder(module, tree, f"<mutant of {module}>"))
        import pytest
        from hypothesis import Phase, settings

        settings.register_profile(PROFILE, phases=(Phase.explicit, Phase.generate), deadline=None)
        code = int(pytest.main([*PYTEST, *tests]))
    except BaseException:
        code = 1
    os._exit(code)


def tests_of(target: Path) -> list[str]:
    """Return the tests of a module, its own first, or of a folder."""
    place = ROOT / "tests" / "unit" / target.relative_to(ROOT)
    folder = place if target.is_dir() else place.parent
    found = sorted(folder.glob("test_*.py"))
    if target.is_file():
        first = folder / f"test_{target.stem}.py"
        own = [first, *sorted(folder.glob(f"test_{target.stem}_*.py"))]
        is_guard = target.parent.name == "guard"
        found = [*own, *(path for path in found if path not in own)] if is_guard else own
    missing = [path for path in found if not path.is_file()]
    if not found or missing:
        raise ConfigError(f"{target.relative_to(ROOT)}: no tests in {folder.relative_to(ROOT)}")
    return [str(path) for path in found]


def preload() -> None:
    """Import modules outside the project once, before forking."""
    for name in ("pytest", "hypothesis.strategies", "numpy", "pymavlink.dialects.v20.common"):
        importlib.import_module(name)
    strange = [
        name for name in sys.modules if name.startswith(("companion.guard", "companion.mav"))
    ]
    for name in strange:
        del sys.modules[name]


@dataclass(slots=True)
class Verdicts:
    """Verdicts on the mutants so far."""

    survived: list[Mutant]
    killed: int = 0
    timeouts: int = 0

    def take(self, mutant: Mutant, status: int) -> None:
        """Record the exit of a mutant's process."""
        if status == 0:
            self.survived.append(mutant)
            print(f"survived so far: {mutant.key}", file=sys.stderr, flush=True)
        elif os.WIFSIGNALED(status):
            self.timeouts += 1
        else:
            self.killed += 1


def run(targets: Sequence[Path], jobs: int, only: str) -> Verdicts:
    """Test every mutant of every module."""
    verdicts, running = Verdicts([]), dict[int, Mutant]()

    def reap() -> None:
        """Wait for a process to end, and note its verdict."""
        pid, status = os.wait()
        verdicts.take(running.pop(pid), status)

    for path in targets:
        tests = tests_of(path)
        if os.waitpid(start(tests), 0)[1]:
            raise ConfigError(f"{path.relative_to(ROOT)}: its tests fail without any change")
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for mutant, tree in mutants_of(path, ROOT):
            if only not in mutant.key:
                continue
            if len(running) >= jobs:
                reap()
            running[start(tests, module, tree)] = mutant
    while running:
        reap()
    return verdicts


# Report


def equivalents() -> dict[str, str]:
    """Return mutants that change nothing, each with its reason.

    Raises:
        ConfigError: There are more than may be, or one has no reason.
    """
    lines = EQUIVALENTS.read_text().splitlines() if EQUIVALENTS.is_file() else []
    listed: dict[str, str] = {}
    for line in (line for line in lines if line and not line.startswith("#")):
        key, _, reason = line.partition(" # ")
        if not reason:
            raise ConfigError(f"{EQUIVALENTS.name}: `{key}` has no reason")
        listed[key.strip()] = reason.strip()
    if len(listed) > MOST_EQUIVALENTS:
        raise ConfigError(f"{EQUIVALENTS.name}: {len(listed)} lines, at most {MOST_EQUIVALENTS}")
    return listed


def modules(paths: Sequence[Path]) -> list[Path]:
    """Return the modules at the given paths.

    Raises:
        ConfigError: A path names no module.
    """
    found: list[Path] = []
    for path in (path.resolve() for path in paths):
        inside = sorted(path.glob("*.py")) if path.is_dir() else [path]
        inside = [p for p in inside if p.is_file() and p.suffix == ".py"]
        if not inside or ROOT not in path.parents:
            raise ConfigError(f"{path}: no module of this project")
        found += [module for module in inside if module.name != "__init__.py"]
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Test every mutant, print the survivors; return the exit code."""
    parser = OneLineParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("paths", nargs="*", type=Path, default=[ROOT / "companion" / "guard"])
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--jobs", type=positive, default=2, metavar="N")
    parser.add_argument("--only", default="", metavar="TEXT", help="mutants whose name has this")
    arguments = parser.parse_args(argv)
    started_s = time.monotonic()
    try:
        known, targets = equivalents(), modules(arguments.paths)
        preload()
        verdicts = run(targets, arguments.jobs, arguments.only)
    except CompanionError as error:
        print(f"mutate_guard: {error}", file=sys.stderr)
        return 2
    excused = [m for m in verdicts.survived if m.key in known]
    left = [m for m in verdicts.survived if m.key not in known]
    for mutant in left:
        print(f"SURVIVED {mutant.key}")
        print(f"  {mutant.path}:{mutant.line}\n  - {mutant.before}\n  + {mutant.after}")
    tried = verdicts.killed + verdicts.timeouts + len(verdicts.survived)
    seconds = time.monotonic() - started_s
    print(
        f"{tried} mutants: {verdicts.killed} killed, {verdicts.timeouts} killed by time, "
        f"{len(excused)} equivalent, {len(left)} survived; {seconds:.0f} s"
    )
    if arguments.json is not None:
        figures = {
            "mutants": tried,
            "killed": verdicts.killed,
            "killed_by_time": verdicts.timeouts,
            "equivalent": [asdict(m) | {"reason": known[m.key]} for m in excused],
            "survived": [asdict(m) for m in left],
            "seconds": round(seconds, 1),
        }
        write_json_atomic(arguments.json, figures)
    return 1 if left else 0


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
