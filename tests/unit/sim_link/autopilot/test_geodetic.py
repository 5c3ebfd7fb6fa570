"""The quick conversion of reports against the exact one."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.coordinates import LocalOrigin
from sim_link.autopilot.estimator import GeodeticReports

METRES_PER_DEGREE = 111_000.0


@pytest.mark.parametrize("latitude_deg", [-75.0, 0.0, 47.4])
def test_a_report_is_the_exact_place_to_a_millimetre_or_two(latitude_deg: float) -> None:
    origin = LocalOrigin(latitude_deg, 8.5, 488.0)
    reports = GeodeticReports(origin)
    for place in np.random.default_rng(1).uniform(-2000.0, 2000.0, (300, 3)).tolist():
        lat, lon, alt = reports.geodetic_from_enu(tuple(place))
        exact = origin.geodetic_from_enu(tuple(place))
        assert lat == pytest.approx(exact[0], abs=0.002 / METRES_PER_DEGREE)
        scale = METRES_PER_DEGREE * np.cos(np.radians(latitude_deg))
        assert lon == pytest.approx(exact[1], abs=0.002 / scale)
        assert alt == pytest.approx(exact[2], abs=0.002)


def test_a_report_depends_on_the_place_only() -> None:
    origin = LocalOrigin(47.4, 8.5, 488.0)
    near, far = GeodeticReports(origin), GeodeticReports(origin)
    far.geodetic_from_enu((5000.0, -3000.0, 100.0))
    assert near.geodetic_from_enu((10.0, 20.0, 5.0)) == far.geodetic_from_enu((10.0, 20.0, 5.0))
