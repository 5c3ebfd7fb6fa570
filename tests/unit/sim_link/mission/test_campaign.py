"""What a campaign makes of its scripts before anything flies, and of flights that go wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from sim_link.mission.campaign import Campaign

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
    assert len(Campaign(files, seeds=(0, 1)).tasks()) == 4
    with pytest.raises(ConfigError) as caught:
        Campaign(files, speed=speed, reports=tmp_path).tasks()
    assert all(str(path) in str(caught.value) for path in files)


def test_names_that_differ_only_beyond_the_cut_are_refused_too(tmp_path: Path) -> None:
    texts = [SCRIPT.replace("same", "x" * 100 + end) for end in "ab"]
    files = [script(tmp_path, f"{n}.yaml", text) for n, text in enumerate(texts)]
    with pytest.raises(ConfigError, match=r"1\.yaml: .*0\.yaml"):
        Campaign(files, reports=tmp_path).tasks()


def test_a_flights_folder_tells_how_it_was_flown(tmp_path: Path) -> None:
    path = script(tmp_path, "m.yaml")
    link = "udpin:127.0.0.1:14550"
    campaigns = [
        Campaign([path]),
        Campaign([path], speed=4.0),
        Campaign([path], speed=1.0, connect=link),
    ]
    assert [task.flight_name for campaign in campaigns for task in campaign.tasks()] == [
        "same-px4-lockstep-seed0",
        "same-px4-speed-4-seed0",
        "same-vehicle-udpin-127.0.0.1-14550-seed0",
    ]


def test_an_autopilot_is_listed_once(tmp_path: Path) -> None:
    path = script(tmp_path, "m.yaml", SCRIPT + "autopilots: [px4, px4]\n")
    with pytest.raises(ConfigError, match="autopilots: px4 is listed more than once"):
        Campaign([path]).tasks()
