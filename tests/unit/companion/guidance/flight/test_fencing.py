from __future__ import annotations

import pytest

from companion.config.schema import LimitsConfig
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.geofence import DISTORTION, GeoArea, GeoFence
from companion.geometry.polygons import Point
from companion.guard.gate import Guard
from companion.guidance.events import AutopilotFenceRead, FenceLimits
from companion.guidance.fencing import FencePlan, FencePolicy, Fencing

ORIGIN = LocalOrigin(47.397742, 8.545594, 488.0)
AWAY = LocalOrigin(46.397742, 8.545594, 488.0)
SQUARE = ((-80.0, -80.0), (80.0, -80.0), (80.0, 80.0), (-80.0, 80.0))
WIDER = ((-80.0, -80.0), (95.0, -80.0), (95.0, 80.0), (-80.0, 80.0))
HOUSE = ((10.0, 10.0), (30.0, 10.0), (30.0, 30.0), (10.0, 30.0))
YARD = ((-30.0, -30.0), (-10.0, -30.0), (-10.0, -10.0), (-30.0, -10.0))
NO_FENCE = AutopilotFenceRead(0.0)
SILENT = AutopilotFenceRead(0.0, problem="no answer")
LIMITS = LimitsConfig(fence_enu_m=SQUARE).guard_limits()
WITHOUT = LimitsConfig(autopilot_fence="use").guard_limits()


def on_globe(*polygons: tuple[Point, ...]) -> GeoFence:
    areas = [
        GeoArea(tuple(ORIGIN.geodetic_from_enu((e, n, 0.0))[:2] for e, n in polygon))
        for polygon in polygons
    ]
    return GeoFence(areas[0], tuple(areas[1:]))


def read(*polygons: tuple[Point, ...]) -> AutopilotFenceRead:
    return AutopilotFenceRead(0.0, on_globe(*polygons))


def local(policy: FencePolicy, keep_outs: tuple[tuple[Point, ...], ...] = ()) -> Fencing:
    limits = LimitsConfig(fence_enu_m=SQUARE, keep_out_enu_m=keep_outs).guard_limits()
    return Fencing(Guard(limits), FencePlan(limits, 3.0, keep_outs, None, policy))


def of_file(policy: FencePolicy = FencePolicy.IGNORE) -> Fencing:
    plan = FencePlan(WITHOUT, 3.0, (YARD,), on_globe(SQUARE, HOUSE), policy)
    return Fencing(Guard(WITHOUT), plan)


def guards_fence(fencing: Fencing) -> tuple[Point, ...] | None:
    fence = fencing.guard.limits.fence
    return None if fence is None else fence.polygon_enu_m


def test_a_guard_with_its_fence_needs_nothing_else() -> None:
    fencing = Fencing(Guard(LIMITS))
    assert fencing.is_ready
    assert guards_fence(fencing) == SQUARE
    assert not fencing.wants_reading
    assert fencing.description == "4 corners, 0 keep-outs, margin 3.0 m"


class TestAFenceInDegrees:
    def test_it_is_there_once_the_origin_is_known(self) -> None:
        fencing = of_file()
        assert guards_fence(fencing) is None
        assert fencing.missing == ["the origin"]
        assert fencing.description == "none"
        fencing.set_origin(ORIGIN)
        assert fencing.is_ready
        fence = fencing.guard.limits.fence
        assert fence is not None
        assert fence.polygon_enu_m[2] == pytest.approx((80.0, 80.0), abs=1e-2)
        assert len(fence.keep_out_enu_m) == 2
        assert fence.keep_out_enu_m[1] == YARD
        assert fence.margin_m == pytest.approx(3.0 + DISTORTION * 80.0 * 2.0**0.5, abs=1e-3)

    def test_it_moves_with_the_origin(self) -> None:
        fencing = of_file()
        fencing.set_origin(ORIGIN)
        fencing.set_origin(LocalOrigin(*ORIGIN.geodetic_from_enu((10.0, 0.0, 0.0))))
        polygon = guards_fence(fencing)
        assert polygon is not None
        assert polygon[2] == pytest.approx((70.0, 80.0), abs=1e-2)

    def test_far_away_it_is_refused_and_nothing_is_left_of_it(self) -> None:
        fencing = of_file()
        fencing.set_origin(ORIGIN)
        fencing.set_origin(AWAY)
        assert "111 km from the autopilot's origin" in str(fencing.refusal)
        assert guards_fence(fencing) is None
        assert not fencing.is_ready

    def test_a_restart_forgets_origin_and_fence(self) -> None:
        fencing = of_file(FencePolicy.COMPARE)
        fencing.set_origin(ORIGIN)
        fencing.take(NO_FENCE)
        assert fencing.is_ready
        fencing.forget()
        assert fencing.missing == ["the autopilot's fence", "the origin"]
        assert guards_fence(fencing) is None
        assert fencing.note is None


class TestComparing:
    @pytest.mark.parametrize("policy", [FencePolicy.COMPARE, FencePolicy.REQUIRE])
    def test_the_same_fence_is_taken(self, policy: FencePolicy) -> None:
        for fencing, same in (
            (local(policy), read(SQUARE)),
            (of_file(policy), read(SQUARE, HOUSE)),
        ):
            assert fencing.wants_reading
            assert "the autopilot's fence" in fencing.missing
            fencing.take(same)
            assert fencing.missing == ["the origin"]
            fencing.set_origin(ORIGIN)
            assert fencing.is_ready
            assert fencing.note is None
            assert not fencing.wants_reading

    @pytest.mark.parametrize("policy", [FencePolicy.COMPARE, FencePolicy.REQUIRE])
    def test_another_fence_is_refused_with_what_differs(self, policy: FencePolicy) -> None:
        for fencing, other in ((local(policy), read(WIDER)), (of_file(policy), read(WIDER, HOUSE))):
            fencing.set_origin(ORIGIN)
            fencing.take(other)
            text = str(fencing.refusal)
            assert text.startswith("the autopilot's fence differs: borders up to 15.")
            assert guards_fence(fencing) is None
            assert fencing.wants_reading
            assert len(text) < 170

    def test_another_exclusion_is_refused(self) -> None:
        fencing = of_file(FencePolicy.COMPARE)
        fencing.set_origin(ORIGIN)
        fencing.take(read(SQUARE))
        assert "the autopilot's has no such exclusion" in str(fencing.refusal)

    def test_keep_outs_of_our_own_need_not_be_the_autopilots(self) -> None:
        fencing = local(FencePolicy.REQUIRE, (HOUSE,))
        fencing.set_origin(ORIGIN)
        for theirs in (read(SQUARE), read(SQUARE, HOUSE)):
            fencing.take(theirs)
            assert fencing.is_ready
        fencing.take(read(SQUARE, YARD))
        assert "ours has no such exclusion" in str(fencing.refusal)
        fencing = of_file(FencePolicy.REQUIRE)
        fencing.set_origin(LocalOrigin(*ORIGIN.geodetic_from_enu((0.5, 0.0, 0.0))))
        fencing.take(read(SQUARE, HOUSE))
        assert fencing.is_ready

    def test_a_fence_mended_on_the_autopilot_is_taken(self) -> None:
        fencing = local(FencePolicy.COMPARE)
        fencing.set_origin(ORIGIN)
        fencing.take(read(WIDER))
        fencing.take(read(SQUARE))
        assert fencing.is_ready
        assert guards_fence(fencing) == SQUARE

    @pytest.mark.parametrize("answer", [NO_FENCE, SILENT])
    def test_none_is_said_and_allowed_or_refused(self, answer: AutopilotFenceRead) -> None:
        allowed, refused = local(FencePolicy.COMPARE), local(FencePolicy.REQUIRE)
        for fencing in (allowed, refused):
            fencing.take(answer)
        assert allowed.is_ready
        assert allowed.note is not None
        assert guards_fence(allowed) == SQUARE
        assert refused.refusal is not None
        assert guards_fence(refused) is None

    def test_a_fence_that_cannot_be_kept_is_refused(self) -> None:
        unusable = AutopilotFenceRead(0.0, problem="item 3: torn", is_unusable=True)
        for policy in (FencePolicy.COMPARE, FencePolicy.REQUIRE, FencePolicy.USE):
            fencing = local(policy)
            fencing.take(unusable)
            assert fencing.refusal == "the autopilot's fence: item 3: torn"

    def test_silence_is_asked_again_and_the_answer_counts(self) -> None:
        fencing = local(FencePolicy.COMPARE)
        fencing.set_origin(ORIGIN)
        fencing.take(SILENT)
        assert fencing.is_ready
        assert fencing.wants_reading
        fencing.take(read(WIDER))
        assert not fencing.is_ready


class TestUsingTheAutopilots:
    def test_it_becomes_ours(self) -> None:
        plan = FencePlan(WITHOUT, 3.0, (YARD,), None, FencePolicy.USE)
        fencing = Fencing(Guard(WITHOUT), plan)
        assert fencing.missing == ["the autopilot's fence"]
        fencing.take(read(WIDER, HOUSE))
        assert fencing.missing == ["the origin"]
        fencing.set_origin(ORIGIN)
        assert fencing.is_ready
        polygon = guards_fence(fencing)
        assert polygon is not None
        assert polygon[1] == pytest.approx((95.0, -80.0), abs=1e-2)
        assert fencing.description == "4 corners, 2 keep-outs, margin 3.9 m"

    @pytest.mark.parametrize(
        ("answer", "problem"),
        [(NO_FENCE, "the autopilot has no fence to use"), (SILENT, "autopilot's fence: no answer")],
    )
    def test_without_one_there_is_none(self, answer: AutopilotFenceRead, problem: str) -> None:
        fencing = Fencing(Guard(WITHOUT), FencePlan(WITHOUT, 3.0, policy=FencePolicy.USE))
        fencing.set_origin(ORIGIN)
        fencing.take(answer)
        assert problem in str(fencing.refusal)
        assert guards_fence(fencing) is None

    def test_one_that_the_margin_closes_is_refused(self) -> None:
        fencing = Fencing(Guard(WITHOUT), FencePlan(WITHOUT, 90.0, policy=FencePolicy.USE))
        fencing.set_origin(ORIGIN)
        fencing.take(read(SQUARE))
        assert "leaves nothing of the fence" in str(fencing.refusal)


class TestAFenceInLocalMetres:
    STEP = LocalOrigin(*ORIGIN.geodetic_from_enu((10.0, -4.0, 0.0)))

    def test_it_stays_where_it_was_when_the_origin_moves(self) -> None:
        fencing = local(FencePolicy.IGNORE, (HOUSE,))
        fencing.set_origin(ORIGIN)
        fencing.set_origin(self.STEP)
        fence = fencing.guard.limits.fence
        assert fence is not None
        assert fence.polygon_enu_m[2] == pytest.approx((70.0, 84.0), abs=1e-3)
        assert fence.keep_out_enu_m[0][0] == pytest.approx((0.0, 14.0), abs=1e-3)
        assert fence.margin_m == pytest.approx(3.0 + DISTORTION * 116.0**0.5, abs=1e-4)

    def test_it_comes_back_with_the_origin(self) -> None:
        fencing = local(FencePolicy.IGNORE)
        for origin in (ORIGIN, self.STEP, ORIGIN):
            fencing.set_origin(origin)
        assert guards_fence(fencing) == SQUARE

    def test_keep_outs_beside_a_file_stay_too(self) -> None:
        fencing = of_file()
        fencing.set_origin(ORIGIN)
        fencing.set_origin(self.STEP)
        fence = fencing.guard.limits.fence
        assert fence is not None
        assert fence.keep_out_enu_m[1][0] == pytest.approx((-40.0, -26.0), abs=1e-3)

    def test_it_outlives_a_restart_of_the_autopilot(self) -> None:
        fencing = local(FencePolicy.IGNORE)
        fencing.set_origin(ORIGIN)
        fencing.forget()
        assert fencing.missing == ["the origin"]
        assert guards_fence(fencing) is None
        fencing.set_origin(self.STEP)
        polygon = guards_fence(fencing)
        assert polygon is not None
        assert polygon[2] == pytest.approx((70.0, 84.0), abs=1e-3)

    @pytest.mark.parametrize("is_origin_first", [True, False])
    def test_it_outlives_a_restart_of_ours(self, is_origin_first: bool) -> None:
        fencing = local(FencePolicy.IGNORE)
        if is_origin_first:
            fencing.set_origin(self.STEP)
        fencing.recall(ORIGIN)
        if not is_origin_first:
            assert guards_fence(fencing) is None
            fencing.set_origin(self.STEP)
        polygon = guards_fence(fencing)
        assert polygon is not None
        assert polygon[2] == pytest.approx((70.0, 84.0), abs=1e-3)

    def test_an_origin_in_another_place_is_refused(self) -> None:
        fencing = local(FencePolicy.IGNORE)
        fencing.set_origin(ORIGIN)
        fencing.set_origin(LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 1500.0, 0.0))))
        assert fencing.refusal is not None
        assert "origin is 1.5 km from where it was" in fencing.refusal
        assert guards_fence(fencing) is None

    def test_the_autopilots_fence_is_compared_in_the_world(self) -> None:
        fencing = local(FencePolicy.REQUIRE)
        fencing.take(read(SQUARE))
        fencing.set_origin(ORIGIN)
        fencing.set_origin(self.STEP)
        assert fencing.refusal is None


SMALL = ((-30.0, -30.0), (30.0, -30.0), (30.0, 30.0), (-30.0, 30.0))
BESIDE = ((0.0, -30.0), (60.0, -30.0), (60.0, 30.0), (0.0, 30.0))
FAR = ((60.0, 60.0), (75.0, 60.0), (75.0, 75.0), (60.0, 75.0))


def flown(policy: FencePolicy, *first: tuple[Point, ...]) -> Fencing:
    """Return the fencing of a flight in control with the fence that was read first."""
    fencing = local(policy)
    if policy is FencePolicy.USE:
        fencing = Fencing(Guard(WITHOUT), FencePlan(WITHOUT, 3.0, (), None, policy))
    fencing.set_origin(ORIGIN)
    fencing.take(read(*first))
    fencing.follow(is_airborne=True, is_in_control=True)
    return fencing


def allowed(fencing: Fencing, *positions: Point) -> list[bool]:
    fence = fencing.guard.limits.fence
    assert fence is not None
    return [fence.allows(position) for position in positions]


class TestAFenceThatChanges:
    def test_a_change_is_missing_before_control_and_wanted_until_it_is_read(self) -> None:
        fencing = local(FencePolicy.COMPARE)
        fencing.set_origin(ORIGIN)
        fencing.take(read(SQUARE))
        assert (fencing.is_ready, fencing.wants_reading) == (True, False)
        fencing.doubt()
        assert fencing.missing == ["the autopilot's fence"]
        assert fencing.wants_reading
        assert guards_fence(fencing) == SQUARE  # what flies holds inside of it
        fencing.take(read(SQUARE))
        assert (fencing.is_ready, fencing.wants_reading) == (True, False)

    def test_control_and_a_home_that_moves_want_it_read_once_more(self) -> None:
        fencing = flown(FencePolicy.USE, SQUARE)
        assert fencing.wants_reading
        assert fencing.is_urgent
        fencing.take(read(SQUARE))
        assert not fencing.wants_reading
        fencing.read_again()
        assert fencing.is_urgent

    @pytest.mark.parametrize("policy", [FencePolicy.USE, FencePolicy.COMPARE, FencePolicy.REQUIRE])
    def test_in_the_air_it_only_shrinks(self, policy: FencePolicy) -> None:
        fencing = flown(policy, SQUARE)
        inside, out, far = (20.0, 0.0), (50.0, 0.0), (85.0, 0.0)
        fencing.take(read(SMALL))
        assert allowed(fencing, inside, out, far) == [True, False, False]
        fencing.take(read(WIDER))
        assert allowed(fencing, inside, out, far) == [True, False, False]
        fencing.take(NO_FENCE)
        assert allowed(fencing, inside, out, far) == [True, False, False]

    def test_fences_that_overlap_hold_together(self) -> None:
        fencing = flown(FencePolicy.USE, SMALL)
        fencing.take(read(BESIDE))
        assert allowed(fencing, (20.0, 0.0), (-10.0, 0.0), (40.0, 0.0)) == [True, False, False]
        assert fencing.description.startswith("4 corners, 0 keep-outs, further fences: 1")

    def test_keep_outs_are_kept_too(self) -> None:
        fencing = flown(FencePolicy.USE, SQUARE, HOUSE)
        fencing.take(read(SQUARE, YARD))
        assert allowed(fencing, (20.0, 20.0), (-20.0, -20.0), (0.0, 0.0)) == [False, False, True]

    def test_nothing_in_common_is_refused(self) -> None:
        fencing = flown(FencePolicy.USE, SMALL)
        fencing.take(read(FAR))
        assert fencing.refusal is not None
        assert guards_fence(fencing) is None

    def test_what_cannot_be_read_in_the_air_changes_nothing(self) -> None:
        fencing = flown(FencePolicy.USE, SMALL)
        before = guards_fence(fencing)
        fencing.doubt()
        fencing.take(SILENT)
        assert fencing.is_doubted
        assert guards_fence(fencing) == before

    def test_a_restart_of_the_autopilot_in_the_air_keeps_the_fences_of_the_flight(self) -> None:
        fencing = flown(FencePolicy.USE, SMALL)
        fencing.take_limits(FenceLimits(altitude_max_m=40.0))
        fencing.forget()
        fencing.set_origin(ORIGIN)
        fencing.take(read(SQUARE))
        fencing.take_limits(FenceLimits(altitude_max_m=60.0))
        assert allowed(fencing, (20.0, 0.0), (50.0, 0.0)) == [True, False]
        assert fencing.guard.limits.envelope.altitude_max_m == 40.0

    def test_a_home_that_moves_in_the_air_takes_no_circle_with_it(self) -> None:
        fencing = flown(FencePolicy.USE, SQUARE)
        fencing.set_home((0.0, 0.0))
        fencing.take_limits(FenceLimits(radius_m=40.0))
        positions = (-30.0, 0.0), (20.0, 0.0), (50.0, 0.0)
        assert allowed(fencing, *positions) == [True, True, False]
        fencing.set_home((25.0, 0.0))
        assert allowed(fencing, *positions) == [False, True, False]
        fencing.follow(is_airborne=False, is_in_control=False)
        assert allowed(fencing, *positions) == [False, True, True]

    @pytest.mark.parametrize("moved_m", [0.0, 25.0])
    def test_the_circle_of_a_flight_outlives_a_restart_of_ours(self, moved_m: float) -> None:
        before = flown(FencePolicy.USE, SQUARE)
        before.set_home((0.0, 0.0))
        before.take_limits(FenceLimits(radius_m=40.0))
        after = flown(FencePolicy.USE, SQUARE)
        after.take_limits(FenceLimits(radius_m=60.0))
        after.set_home((moved_m, 0.0))
        after.recall_flown(before.flown, before.fence_limits)
        assert allowed(after, (moved_m - 20.0, 0.0), (50.0, 0.0)) == [True, False]
        assert f"further fences: {1 if moved_m == 0.0 else 2}" in after.description

    def test_on_the_ground_the_newest_parameters_count(self) -> None:
        fencing = flown(FencePolicy.USE, SQUARE)
        fencing.take_limits(FenceLimits(altitude_max_m=20.0))
        fencing.take_limits(FenceLimits(altitude_max_m=40.0))
        assert fencing.guard.limits.envelope.altitude_max_m == 20.0
        fencing.follow(is_airborne=False, is_in_control=False)
        assert fencing.guard.limits.envelope.altitude_max_m == 40.0

    def test_on_the_ground_only_the_newest_counts(self) -> None:
        fencing = flown(FencePolicy.USE, SMALL)
        fencing.take(read(SQUARE))
        fencing.follow(is_airborne=False, is_in_control=False)
        assert allowed(fencing, (50.0, 0.0)) == [True]
        fencing = flown(FencePolicy.COMPARE, SQUARE)
        fencing.take(read(SMALL))
        fencing.follow(is_airborne=False, is_in_control=False)
        assert fencing.refusal is not None
        assert "differs" in fencing.refusal
