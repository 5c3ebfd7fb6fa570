"""A campaign's treatment of its scripts before anything flies, and of failed flights."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from pathlib import Path
from xml.etree import ElementTree

import pytest

from companion.entry import is_interrupt
from companion.errors import CompanionError, ConfigError
from sim_link import cli
from sim_link.lab.mission.batch import MissionBatch, fly_all, fly_task
from sim_link.lab.mission.conditions import FlightSituation
from sim_link.lab.mission.in_memory import Progress, fly_in_memory
from sim_link.lab.mission.results import MissionResult
from sim_link.lab.mission.script import Mission
from sim_link.lab.mission.steps import StepRunner
from tests.ports import free_port

SCRIPT = "name: same\nsteps: [connect]\n"


def script(folder: Path, name: str, text: str = SCRIPT) -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize("speed", [None, 4.0])
def test_two_flights_of_one_name_are_refused_where_reports_are_wanted(
    tmp_path: Path, speed: float | None
) -> None:
    files = [script(tmp_path, "a/m.yaml"), script(tmp_path, "b/m.yaml")]
    assert len(MissionBatch(files, seeds=(0, 1)).tasks()) == 4
    with pytest.raises(ConfigError) as caught:
        MissionBatch(files, speed=speed, reports=tmp_path).tasks()
    assert all(str(path) in str(caught.value) for path in files)


def test_names_that_differ_only_beyond_the_cut_are_refused_too(tmp_path: Path) -> None:
    texts = [SCRIPT.replace("same", "x" * 90 + end) for end in "ab"]
    files = [script(tmp_path, f"{n}.yaml", text) for n, text in enumerate(texts)]
    with pytest.raises(ConfigError, match=r"1\.yaml: .*0\.yaml"):
        MissionBatch(files, reports=tmp_path).tasks()


def test_a_flights_folder_tells_how_it_was_flown(tmp_path: Path) -> None:
    path = script(tmp_path, "m.yaml")
    link = "udpout:127.0.0.1:14550"
    flown = [
        MissionBatch([path]),
        MissionBatch([path], speed=4.0),
        MissionBatch([path], speed=1.0, connect=link),
    ]
    assert [task.flight_name for campaign in flown for task in campaign.tasks()] == [
        "same-px4-lockstep-seed0",
        "same-px4-speed-4-seed0",
        "same-vehicle-udpout-127.0.0.1-14550-seed0",
    ]


def test_an_autopilot_is_listed_once(tmp_path: Path) -> None:
    path = script(tmp_path, "m.yaml", SCRIPT + "autopilots: [px4, px4]\n")
    with pytest.raises(ConfigError, match="autopilots: px4 is listed more than once"):
        MissionBatch([path]).tasks()


@pytest.mark.parametrize("link", ["udpin:127.0.0.1:{port}", "serial:/dev/nothere:57600", "x:y"])
def test_a_link_that_cannot_be_opened_is_reported_before_anything_starts(
    tmp_path: Path, link: str
) -> None:
    path = script(tmp_path, "m.yaml")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = link.format(port=taken.getsockname()[1])
        with pytest.raises(CompanionError):
            MissionBatch([path], speed=1.0, connect=url).tasks()


def run(*arguments: object) -> int:
    return cli.main(["mission", "run", *map(str, arguments)])


def counts(junit: Path) -> list[str | None]:
    root = ElementTree.parse(junit).getroot()
    return [root.get(name) for name in ("tests", "failures", "errors")]


def test_a_folder_that_takes_no_reports_is_reported_before_anything_flies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(script(tmp_path, "m.yaml"), "--report", "/proc") == 2
    said = capsys.readouterr()
    assert said.err.startswith("sim-link: --report /proc: cannot be written")
    assert said.out == ""


def test_the_folder_of_the_reports_is_made_before_the_junit_file_is_looked_at(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "new"
    path = script(tmp_path, "m.yaml")
    assert run(path, "--report", folder, "--junit", folder / "j.xml") == 0
    assert counts(folder / "j.xml") == ["1", "0", "0"]


def test_a_report_that_cannot_be_written_fails_its_flight_and_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reports, junit = tmp_path / "reports", tmp_path / "j.xml"
    (reports / "same-px4-lockstep-seed0.html").mkdir(parents=True)
    path = script(tmp_path, "m.yaml")
    assert run(path, "--repeat", 2, "--report", reports, "--junit", junit) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if "/2]" in line] == ["FAIL", "PASS"]
    assert "cannot be written" in lines[1]
    assert lines[-1].startswith("1 of 2 flights passed")
    assert counts(junit) == ["3", "0", "1"]


def test_a_flight_that_cannot_be_flown_is_an_error_and_the_others_are_flown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fly(
        mission: Mission, seed: int, file: str, progress: Progress | None = None
    ) -> MissionResult:
        if seed == 0:
            raise CompanionError("the companion did not start")
        return fly_in_memory(mission, seed, file, progress)

    monkeypatch.setattr("sim_link.lab.mission.batch.fly_in_memory", fly)
    junit = tmp_path / "j.xml"
    assert run(script(tmp_path, "m.yaml"), "--repeat", 2, "--junit", junit) == 1
    assert counts(junit) == ["2", "0", "1"]


def test_a_script_for_another_autopilot_is_skipped_with_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "name: only\nautopilots: [px4]\nsteps: [connect]\n"
    text += "autopilot: {parameters: {COM_OBL_RC_ACT: 5}}\n"
    files = [script(tmp_path, "only.yaml", text), script(tmp_path, "m.yaml")]
    junit = tmp_path / "j.xml"
    assert run(*files, "--autopilot", "ardupilot", "--junit", junit, "--report", tmp_path) == 0
    first, second, *_, last = capsys.readouterr().out.splitlines()
    assert first == (
        "SKIP [1/2] only (ardupilot), seed 0: the script is for px4, and this is ardupilot"
    )
    assert second.startswith("PASS [2/2] same (ardupilot)")
    assert last.startswith("1 of 1 flights passed, 1 skipped")
    assert len(list(tmp_path.glob("*.html"))) == 1


def test_a_script_that_breaks_the_vehicle_is_not_flown_on_one_of_others(tmp_path: Path) -> None:
    steps = "[connect, {inject: {kind: battery}}]"
    path = script(tmp_path, "m.yaml", f"name: breaks\nsteps: {steps}\n")
    (task,) = MissionBatch([path], speed=1.0, connect=f"udpin:127.0.0.1:{free_port()}").tasks()
    result = fly_task(task)  # a silent link would cost a quarter of a minute
    assert "cannot be broken" in result.record.skipped
    assert result.title == "breaks (vehicle), seed 0"


@pytest.mark.parametrize("is_compiled", [False, True])
def test_an_interrupt_of_the_warm_up_is_reported_in_a_line_and_in_junit(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    is_compiled: bool,
) -> None:
    def warm_up(_tasks: object) -> None:
        if is_compiled:
            raise SystemError("returned a result with an exception set") from KeyboardInterrupt()
        raise KeyboardInterrupt

    monkeypatch.setattr("sim_link.lab.mission.batch.warm_up", warm_up)
    junit = tmp_path / "j.xml"
    assert run(script(tmp_path, "m.yaml"), "--repeat", 2, "--junit", junit) == 1
    assert capsys.readouterr().err == "sim-link: interrupted after 0 of 2 flights\n"
    assert counts(junit) == ["2", "0", "2"]
    assert "interrupted" in junit.read_text()


def test_an_interrupt_while_scripts_are_looked_at_is_reported_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def check(_mission: Mission, _name: str) -> None:
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setattr("sim_link.lab.mission.batch.check_flyable", check)
    assert run(script(tmp_path, "m.yaml")) == 1
    assert capsys.readouterr().err == "sim-link: interrupted\n"


def test_other_errors_are_no_interrupts() -> None:
    assert not is_interrupt(SystemError("x"))
    assert not is_interrupt(None)


def test_what_was_flown_before_an_interrupt_is_kept(tmp_path: Path) -> None:
    path = script(tmp_path, "m.yaml")
    tasks = MissionBatch([path], seeds=range(3)).tasks()
    finished: list[int] = []

    def done(position: int, summary: MissionResult) -> None:
        assert summary.is_passed
        finished.append(position)

    def progress(_runner: StepRunner, _situation: FlightSituation) -> None:
        if len(finished) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fly_all(tasks, 1, done, progress)
    assert finished == [0, 1]


LONG = "name: long\nsteps: [connect, {wait: {for_s: 5000}}]\ntime_limit_s: 10000\n"


@pytest.mark.slow
def test_an_interrupt_of_several_at_once_keeps_what_is_flown_and_ends_the_rest(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    short, junit = script(tmp_path, "m.yaml"), tmp_path / "j.xml"
    long = script(tmp_path, "long.yaml", LONG)

    def interrupt() -> None:
        while "PASS" not in "".join(said):
            said.append(capfd.readouterr().out)
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    said: list[str] = []
    threading.Thread(target=interrupt, daemon=True).start()
    assert run(short, long, "--jobs", 2, "--junit", junit) == 1
    assert "interrupted after 1 of 2 flights" in capfd.readouterr().err
    assert counts(junit) == ["2", "0", "1"]


@pytest.mark.parametrize("is_slow", [True, False])
def test_kernels_that_are_compiled_for_long_are_explained_at_any_output(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    is_slow: bool,
) -> None:
    def warm_up(_: object) -> None:
        for timer in timers() if is_slow else ():
            timer.join()

    def timers() -> list[threading.Timer]:
        return [each for each in threading.enumerate() if isinstance(each, threading.Timer)]

    module = "sim_link.lab.mission.mission_cli"
    monkeypatch.setattr(f"{module}.EXPLAINED_AFTER_S", 0.0 if is_slow else 3600.0)
    monkeypatch.setattr(f"{module}.batch.warm_up", warm_up)
    monkeypatch.setattr(f"{module}.batch.fly_all", lambda *_: None)
    cli.main(["mission", "run", str(script(tmp_path, "m.yaml"))])
    assert capsys.readouterr().err.startswith("sim-link: compiling kernels") == is_slow
    assert not any(timer.is_alive() and not timer.finished.is_set() for timer in timers())
