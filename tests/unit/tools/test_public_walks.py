"""Walks of public data sets: small ones in their formats, invented here."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.replay.walk_replay import read_walk
from tools.study.walks.public_walks import FORMATS, librsf_answers, main, rtt_answers, walk_csv

LIBRSF = """range2 10.50 2.25 0.01 -1.5 4.0 105 0
odom2diff 10.50 0 0 0 0.0785 0.0001 0.0001 0.0001
range2 10.75 3.5 0.01 6.0 4.0 107 0
"""
TRUTH = "point2 10.25 0.0 1.0 0 0 0 0\npoint2 10.75 1.0 3.0 0 0 0 0\n"
SCANS = """M1 Time Stamp (ms),AP1 True Distance (m),AP1 RTT Distance (m),AP1 RSS (dBm),\
AP2 RTT Distance (m),M1 Ground Truth
1000.0,5.0,6.25,-65.0,,"[-8.5, 2.0]"
1250.0,5.0,6.5,-66.0,7.75,"[-8.25, 2.0]"
1500.0,5.0,nan,-66.0,-1.0,"[-8.0, 2.0]"
"""
POINTS = ",x,y\nAP1,-14.5,-11.0\nAP2,0,0\n"


def _files(folder: Path, *texts: str) -> list[Path]:
    paths = [folder / f"{index}.txt" for index in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text, encoding="utf-8")
    return paths


def test_a_text_file_has_its_truth_interpolated(tmp_path: Path) -> None:
    first, second = librsf_answers(*_files(tmp_path, LIBRSF, TRUTH))
    assert first == (10.5, (0.5, 2.0), "U105", 2.25, (-1.5, 4.0))
    assert second == (10.75, (1.0, 3.0), "U107", 3.5, (6.0, 4.0))


def test_a_table_of_scans_gives_what_was_heard(tmp_path: Path) -> None:
    found = list(rtt_answers(*_files(tmp_path, SCANS, POINTS)))
    assert [(a.t_s, a.target_id, a.range_m) for a in found] == [
        (1.0, "AP1", 6.25),
        (1.25, "AP1", 6.5),
        (1.25, "AP2", 7.75),
    ]
    assert found[0].agent_m == (-8.5, 2.0)
    assert found[0].target_m == (-14.5, -11.0)


@pytest.mark.parametrize(("kind", "texts"), [("librsf", (LIBRSF, TRUTH)), ("rtt", (SCANS, POINTS))])
def test_what_is_written_is_read_as_a_walk(
    kind: str,
    texts: tuple[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "walk.csv"
    arguments = [kind, *map(str, _files(tmp_path, *texts)), str(out)]
    monkeypatch.setattr("sys.argv", ["public_walks.py", *arguments])
    assert main() == 0
    assert f"{FORMATS[kind][1]}.yaml" in capsys.readouterr().out
    rows = list(read_walk(out))
    assert rows[0].measurement.measured_at_s == 0.0
    assert all(row.truth_enu_m is not None and row.measurement.range_m for row in rows)
    assert (Path("configs/companion") / f"{FORMATS[kind][1]}.yaml").exists()


@pytest.mark.parametrize(
    ("kind", "texts", "complaint"),
    [
        ("librsf", ("range2 1 2\n", TRUTH), "line 1: range2 needs 6 numbers"),
        ("librsf", ("range2 1 x 0 0 0 7\n", TRUTH), "not a number: `x`"),
        ("librsf", (LIBRSF, ""), "no line begins with point2"),
        ("librsf", ("", TRUTH), "no range in it"),
        ("rtt", (SCANS.replace("[-8.5, 2.0]", "here"), POINTS), "Ground Truth: not a number"),
        ("rtt", (SCANS, ",x,y\nAP1,east,0\n"), "x: not a number: `east`"),
    ],
)
def test_what_is_wrong_is_named(
    kind: str, texts: tuple[str, str], complaint: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=complaint):
        walk_csv(FORMATS[kind][0](*_files(tmp_path, *texts)))


def test_a_file_that_is_not_there_is_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["public_walks.py", "rtt", *[str(tmp_path / "none")] * 3])
    assert main() == 2
    assert "cannot be read" in capsys.readouterr().err
