from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tools.fuzz.mutants import mutants_of
from tools.fuzz.mutate_guard import tests_of as chosen_tests

ROOT = Path(__file__).resolve().parents[3]


def changes(folder: Path, source: str) -> set[str]:
    """`before => after` of every mutant of a source."""
    path = folder / "it.py"
    path.write_text(source)
    return {f"{mutant.before} => {mutant.after}" for mutant, _ in mutants_of(path, folder)}


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("ok(a < b)", {"a < b => a <= b", "a < b => a >= b"}),
        ("ok(a == b)", {"a == b => a != b"}),
        ("ok(a is None)", {"a is None => a is not None"}),
        ("ok(a + b)", {"a + b => a - b", "a + b => -(a + b)"}),
        ("ok(a * b)", {"a * b => a / b", "a * b => -(a * b)"}),
        ("ok(-a)", {"-a => a"}),
        ("ok(not a)", {"not a => a"}),
        ("ok(a and b)", {"a and b => a or b", "a and b => a", "a and b => b"}),
        ("ok(a if b else c)", {"a if b else c => a", "a if b else c => c"}),
        ("ok(True)", {"True => False"}),
        ("ok(2.5)", {"2.5 => 3.5", "2.5 => 1.5"}),
        ("ok(min(a, b))", {"min(a, b) => max(a, b)"}),
        ("ok(abs(a))", {"abs(a) => a"}),
        ("ok('a text', None)", set()),
    ],
)
def test_expressions(tmp_path: Path, source: str, expected: set[str]) -> None:
    assert changes(tmp_path, source) == expected | {f"{source} => pass"}


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("a = b", {"a = b => pass"}),
        ("raise a", {"raise a => pass"}),
        ("def f():\n    return a", {"return a => return None"}),
        ("def f():\n    return None", set()),
        ("if a:\n    b()", {"if a: => if True:", "if a: => if False:", "b() => pass"}),
        ("while a:\n    b()", {"while a: => while False:", "b() => pass"}),
    ],
)
def test_statements(tmp_path: Path, source: str, expected: set[str]) -> None:
    assert changes(tmp_path, source) == expected


def test_what_only_names_things_stays(tmp_path: Path) -> None:
    source = '''"""A text."""
import math
from a import b
Point = tuple[float, float]
@dataclass(frozen=True, slots=True)
class A(B):
    """A text."""
    c: int | None
    def f(self, d: int | None) -> int | None:
        """A text."""
'''
    assert changes(tmp_path, source) == set()


def test_equal_changes_are_told_apart_and_named_by_their_place(tmp_path: Path) -> None:
    path = tmp_path / "it.py"
    path.write_text("class A:\n    def f(self):\n        ok(a < b, a < b)\n")
    keys = [mutant.key for mutant, _ in mutants_of(path, tmp_path)]
    assert keys[1:3] == [
        "it.py | A.f | a < b => a <= b | 1",
        "it.py | A.f | a < b => a >= b | 1",
    ]
    assert "it.py | A.f | a < b => a <= b | 2" in keys


@pytest.mark.slow
def test_a_mutant_is_run_and_its_verdict_written(tmp_path: Path) -> None:
    """A real one, over the guard's own tests."""
    report = tmp_path / "mutants.json"
    command = [sys.executable, "-m", "tools.fuzz.mutate_guard", "companion/guard/limits.py"]
    one = ["--only", "next_velocity | size > most => size <= most", "--json", str(report)]
    done = subprocess.run([*command, *one], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.stdout.startswith("1 mutants: 1 killed, 0 killed by time, 0 equivalent, 0 survived")
    assert done.returncode == 0
    assert json.loads(report.read_text())["killed"] == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "passes"), [("time.sleep(4.0)", True), ("while True:\n        pass", False)]
)
def test_tests_end_by_the_processors_time_so_that_a_busy_machine_kills_no_mutant(
    tmp_path: Path, body: str, passes: bool
) -> None:
    tests = tmp_path / "test_it.py"
    tests.write_text(f"import time\n\ndef test_it():\n    {body}\n")
    code = (
        "import os\nfrom tools.fuzz import mutate_guard as it\n"
        "it.preload()\nit.TIMEOUT_S = 3\n"
        f"raise SystemExit(bool(os.waitpid(it.start([{str(tests)!r}]), 0)[1]))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=300)
    assert (done.returncode == 0) == passes


@pytest.mark.parametrize("path", ["companion/none.py", "/etc", "companion/guard/__pycache__"])
def test_a_path_without_a_module_is_refused(path: str) -> None:
    command = [sys.executable, "-m", "tools.fuzz.mutate_guard", path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "no module of this project" in done.stderr


def chosen_names(module: str) -> list[str]:
    return [Path(name).name for name in chosen_tests(ROOT / module)]


def test_a_module_of_the_guard_meets_its_own_tests_first_and_then_the_others() -> None:
    names = chosen_names("companion/guard/gate.py")
    own = [name for name in names if name.startswith("test_gate")]
    assert own[0] == "test_gate.py"
    assert len(own) > 1
    assert names[: len(own)] == own
    assert {"test_fence.py", "test_stopping.py"} <= set(names[len(own) :])


def test_another_module_meets_all_of_its_own_tests() -> None:
    names = chosen_names("companion/mav/signing.py")
    assert names[0] == "test_signing.py"
    assert "test_signing_keys.py" in names
    assert all(name.startswith("test_signing") for name in names)
