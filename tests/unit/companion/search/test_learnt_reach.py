"""Reach after the first contact."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.search.detection_model import DetectionModel
from companion.search.search_grid import WeightedArea, grid_over
from companion.search.searched_area import LearntReach, SearchedArea, learnt_reach

SIDE_M, HEIGHT_M = 400.0, 20.0
SQUARE = ((0.0, 0.0), (SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M))
MODEL = DetectionModel(reach_m=80.0, reach_sigma_db=4.0, environment="open")
EMITTER = (210.0, 210.0)


def after_lane(north_m: float, *, until_m: float, model: DetectionModel = MODEL) -> LearntReach:
    """A lane past the emitter, heard first at `until_m`."""
    area = SearchedArea(grid_over([WeightedArea(SQUARE)], 20.0), model)
    for east in np.arange(0.0, until_m, 5.0):
        area.listen((float(east), north_m, HEIGHT_M), 1.0)
    area.finish()
    learnt = learnt_reach(area, (until_m, north_m, HEIGHT_M), EMITTER)
    assert learnt is not None
    return learnt


def test_a_contact_from_afar_lengthens_the_reach_and_a_late_one_shortens_it() -> None:
    far, late = after_lane(210.0, until_m=10.0), after_lane(210.0, until_m=205.0)
    assert late.reach_m < 60.0 < 100.0 < far.reach_m
    assert max(far.reach_sigma_db, late.reach_sigma_db) < MODEL.reach_sigma_db


def test_what_is_searched_after_the_contact_for_others_does_not_change_it() -> None:
    area = SearchedArea(grid_over([WeightedArea(SQUARE)], 20.0), MODEL)
    for east in np.arange(0.0, 100.0, 5.0):
        area.listen((float(east), 210.0, HEIGHT_M), 1.0)
    area.note_contact()
    for east in np.arange(100.0, 300.0, 5.0):
        area.listen((float(east), 210.0, HEIGHT_M), 1.0)
    area.finish()
    learnt = learnt_reach(area, (100.0, 210.0, HEIGHT_M), EMITTER)
    assert learnt == after_lane(210.0, until_m=100.0)


def test_a_reach_that_is_known_is_hardly_changed() -> None:
    known = DetectionModel(reach_m=80.0, reach_sigma_db=0.5, environment="rubble")
    learnt = after_lane(210.0, until_m=10.0, model=known)
    assert learnt.reach_m == pytest.approx(80.0, rel=0.02)


def test_over_many_emitters_it_is_nearer_to_the_truth_than_what_was_configured() -> None:
    """True offsets are drawn from the model's own uncertainty; each is heard along a lane."""
    rng = np.random.default_rng(2)
    grid = grid_over([WeightedArea(SQUARE)], 20.0)
    configured, learnt_errors, sigmas = [], [], []
    for _ in range(60):
        error_db = float(rng.normal(0.0, MODEL.reach_sigma_db))
        own_db = float(rng.normal(0.0, math.sqrt(MODEL.cell_sigma_db**2 - MODEL.reach_sigma_db**2)))
        area, emitter = SearchedArea(grid, MODEL), tuple(rng.uniform(100.0, 300.0, 2).tolist())
        path_db, square = 0.0, None
        for east in np.arange(0.0, SIDE_M, 5.0):
            position = (float(east), 200.0, HEIGHT_M)
            if int(east / MODEL.propagation.correlation_m) != square:
                square = int(east / MODEL.propagation.correlation_m)
                path_db = float(rng.normal(0.0, MODEL.path_sigma_db))
            margin = float(MODEL.margin_db(np.array([emitter]), position)[0])
            if margin + error_db + own_db + path_db > 0.0:
                area.finish()
                learnt = learnt_reach(area, position, emitter)
                assert learnt is not None
                shown_db = 10.0 * MODEL.propagation.exponent * math.log10(learnt.reach_m / 80.0)
                configured.append(error_db)
                learnt_errors.append(error_db - shown_db)
                sigmas.append(learnt.reach_sigma_db)
                break
            area.listen(position, 1.0)
    assert len(configured) > 30
    assert np.std(learnt_errors) < 0.95 * np.std(configured)
    assert np.sqrt(np.mean(np.square(learnt_errors))) < 1.3 * np.mean(sigmas)


def test_outside_of_the_area_nothing_is_learnt() -> None:
    area = SearchedArea(grid_over([WeightedArea(SQUARE)], 20.0), MODEL)
    assert learnt_reach(area, (0.0, 0.0, 20.0), (-50.0, 10.0)) is None
