"""A flight that hears nothing, by real processes: it ends by itself and leaves what it searched."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gpxpy
import numpy as np
import pytest
import rasterio
import shapely
import shapely.geometry
from fastkml import KML
from fastkml.overlays import GroundOverlay
from fastkml.utils import find
from fastkml.validator import validate

from tests.e2e.simulator_process import PATIENCE_S, PATIENT
from tests.ports import free_port

pytestmark = pytest.mark.slow
SPEED = "2"
FLIGHT_S = 240.0
CONFIG = """\
mission: {engage: auto, on_localised: land}
limits: {fence_enu_m: [[0, 0], [60, 0], [60, 60], [0, 60]], autopilot_fence: ignore}
planner: {search: lawnmower, pattern: {spacing_m: 25.0}}
search:
  detection: {reach_m: 30.0, reach_sigma_db: 3.0}
  stop_sweeps: 1
"""
FILES = ["searched_area." + end for end in ("geojson", "gpx", "json", "kml", "png", "tif", "txt")]


@contextmanager
def flying(flavour: str, directory: Path) -> Iterator[subprocess.Popen[str]]:
    """A companion with `--once`, and a vehicle whose radio reaches one metre."""
    (directory / "search.yaml").write_text(CONFIG)
    scenario = directory / "scenario.yaml"
    autopilot = PATIENT[flavour] % 60.0
    scenario.write_text(f"autopilot: {{{autopilot}}}\npayload: {{max_range_m: 1.0}}\n")
    port = free_port()
    python = [sys.executable, "-m"]
    vehicle = ["sim_link", "--scenario", str(scenario), "--speed", SPEED]
    vehicle += ["--listen", f"127.0.0.1:{free_port()}", "--send-to", f"127.0.0.1:{port}"]
    companion = ["companion", "--connect", f"udp:127.0.0.1:{port}", "--config", "search.yaml"]
    companion += ["--speed", SPEED, "--once"]
    with (
        subprocess.Popen([*python, *vehicle], stdout=subprocess.DEVNULL) as simulator,
        subprocess.Popen(
            [*python, *companion],
            cwd=directory,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "NUMBA_DISABLE_JIT": "1"},  # nothing is estimated here
        ) as process,
    ):
        try:
            yield process
        finally:
            process.kill()
            simulator.kill()


def check_files(flight: Path) -> dict[str, object]:
    """Open every file by its reader; the result."""
    result = json.loads((flight / "result.json").read_text())
    assert sorted(path.name for path in flight.glob("searched_area.*")) == FILES
    features = json.loads((flight / "searched_area.geojson").read_text())["features"]
    shapes = [(f["properties"], shapely.geometry.shape(f["geometry"])) for f in features]
    assert all(shape.is_valid for _, shape in shapes)
    by_level = {p["pod_at_least"]: s for p, s in shapes if p["kind"] == "pod"}
    assert set(by_level) == {0.5, 0.8, 0.95}
    assert by_level[0.5].covers(by_level[0.8])
    (track,) = [shape for about, shape in shapes if about["kind"] == "track"]
    assert validate(file_to_validate=flight / "searched_area.kml")
    overlay: Any = find(KML.parse(flight / "searched_area.kml"), of_type=GroundOverlay)
    assert overlay.icon.href == "searched_area.png"
    sides = overlay.lat_lon_box
    box = shapely.box(sides.west, sides.south, sides.east, sides.north)
    assert box.buffer(1e-6).covers(by_level[0.5])
    assert box.buffer(1e-4).covers(track)
    (gpx,) = gpxpy.parse((flight / "searched_area.gpx").read_text()).tracks
    points = gpx.segments[0].points
    assert len(points) == len(track.coords) == len(result["track"])
    check_geotiff(flight / "searched_area.tif", by_level[0.8])
    check_png((flight / "searched_area.png").read_bytes())
    return dict(result)


def check_geotiff(path: Path, searched: shapely.Geometry) -> None:
    """Compare the cells of 80 % POD with their outlines."""
    with rasterio.open(path) as image:
        assert image.crs.to_epsg() == 4326
        pod = image.read(1)
        rows, columns = np.indices(pod.shape)
        east, north = rasterio.transform.xy(image.transform, rows.ravel(), columns.ravel())
    assert list(shapely.contains_xy(searched, east, north)) == list(pod.ravel() >= 0.8)


def check_png(data: bytes) -> None:
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", data[16:24])
    at, chunks = 8, {}
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        name, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0] == zlib.crc32(
            name + body
        )
        chunks[name] = body
        at += 12 + length
    assert len(zlib.decompress(chunks[b"IDAT"])) == height * (1 + 4 * width)


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_a_search_that_hears_nothing_ends_and_leaves_what_it_searched(
    flavour: str, tmp_path: Path
) -> None:
    with flying(flavour, tmp_path) as companion:
        _, said = companion.communicate(timeout=FLIGHT_S)
    assert companion.returncode == 3, said
    assert "the search is over, nothing heard" in said
    (flight,) = (tmp_path / "flights").iterdir()
    result = check_files(flight)
    assert result["state"] == "not_found"
    assert float(str(result["pos"])) > 0.9
    assert result["is_radio_heard"] is False
    assert "Searched area" in (flight / "report.html").read_text()
    shown = companion_area("show", str(flight))
    assert shown.strip() == result["statement"]
    merged = companion_area("merge", str(flight), str(flight), "--out", str(tmp_path / "both"))
    assert merged.startswith("2 flights: Nothing heard.")
    assert (tmp_path / "both" / "searched_area.geojson").exists()


def companion_area(*arguments: str) -> str:
    command = [sys.executable, "-m", "companion", "area", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_a_flight_that_is_killed_leaves_the_same_up_to_then(tmp_path: Path) -> None:
    with flying("px4", tmp_path) as companion:
        deadline = time.monotonic() + PATIENCE_S
        while not list(tmp_path.glob("flights/*/searched_area.gpx")):
            assert companion.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        time.sleep(0.5)
        companion.send_signal(signal.SIGKILL)
        companion.wait()
    (flight,) = (tmp_path / "flights").iterdir()
    result = check_files(flight)
    assert result["state"] == "not_found"
    assert 0.0 < float(str(result["pos"])) < 1.0
