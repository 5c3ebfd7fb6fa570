"""A calibration as text, as YAML to paste, and as JSON."""

from __future__ import annotations

import math

from companion.radio_tools.bearing_fit import BearingFit
from companion.radio_tools.calibration import Calibration
from companion.radio_tools.clustered_fit import Figure
from companion.radio_tools.range_fit import RangeFit

PRIOR_WIDTHS = 2.5
"""Width of a prior, in half intervals."""
MIN_PRIOR_M = 0.1
MIN_PRIOR_DEG = 3.0
"""Minimum prior of the bearing offset: a compass is worse elsewhere than where calibrated."""
WHOLE_DEG = 359.0


def verdict(done: Calibration) -> str:
    """Return the result in a few lines."""
    lines = [_heading(done)]
    if done.range_fit is not None:
        lines += _range_lines(done.range_fit, done)
    if done.bearing_fit is not None:
        lines += _bearing_lines(done.bearing_fit, done)
    lines.append(_lag_line(done))
    lines += [f"note: {remark}" for remark in done.remarks]
    lines += [f"refused: {reason}" for reason in done.refusals]
    usable = [
        name
        for name, is_used in (("ranges", done.has_ranges), ("bearings", done.has_bearings))
        if is_used
    ]
    words = "yes" if usable and not done.refusals else f"only {usable[0]}" if usable else "no"
    last = f"usable: {words}"
    if done.range_fit is not None and done.range_fit.worst_m is not None:
        distance_m, far_m = done.range_fit.worst_m
        guess = " (reflection?)" if far_m > 0.0 else ""
        last += f"        worst position: {distance_m:.0f} m, {far_m:+.1f} m{guess}"
    return "\n".join([*lines, last])


def _heading(done: Calibration) -> str:
    distances = "no distances"
    if done.range_fit is not None and done.range_fit.distances_m:
        all_m = done.range_fit.distances_m
        distances = f"{len(all_m)} distances {all_m[0]:.1f}-{all_m[-1]:.1f} m"
    heading = (
        f"radio {done.radio}, emitter {done.emitter_id}: {done.ranges} ranges, {distances}, "
        f"{done.bearings} bearings"
    )
    tests = []
    if done.tests.has_turn:
        tests.append(f"turn of {math.degrees(done.tests.turned_rad):.0f} deg")
    if done.range_fit is not None and len(done.range_fit.distances_m) > 3:
        tests.append("line")
    if done.tests.has_circle:
        tests.append(f"circle at {done.tests.circle_m:.0f} m")
    if done.blocked is not None:
        tests.append(f"blocked for {done.blocked.seconds:.0f} s")
    return heading + f"\ntests found: {', '.join(tests) or 'none'}"


def _range_lines(fit: RangeFit, done: Calibration) -> list[str]:
    scale = "held at 1"
    if fit.is_scale_seen:
        kept = "" if fit.is_scale_used else ", kept at 1"
        scale = f"{fit.scale.value:.3f} ({fit.scale.low:.3f} .. {fit.scale.high:.3f}{kept})"
    lines = [
        f"range offset  {fit.offset_m.value:+.2f} m  (95 % {_interval(fit.offset_m, 2)})"
        f"     scale {scale}"
    ]
    line = (
        f"sigma {fit.sigma_m.value:.2f} m (scatter {fit.scatter_m.value:.2f}, between positions "
        f"{fit.between_m:.2f})  longer than 3 sigma: {100.0 * fit.nlos_share.value:.0f} %"
    )
    if fit.nlos_excess_m is not None:
        line += f", by {fit.nlos_excess_m.value:.1f} m on average"
    lines.append(line)
    if done.blocked is not None and done.blocked.excess_m is not None:
        lines.append(
            f"blocked: {100.0 * done.blocked.share:.0f} % longer than 3 sigma, "
            f"by {done.blocked.excess_m:.1f} m on average"
        )
    if done.range_ratio is not None:
        lines.append(_reported("range", done.range_ratio))
    return lines


def _bearing_lines(fit: BearingFit, done: Calibration) -> list[str]:
    mount, sense = fit.mount_rad.times(180.0 / math.pi), fit.sense
    what = "offset from north" if done.is_by_north else "mount"
    fold = "front and back distinguished"
    if sense.is_folded:
        fold = f"two antennas: front and back look alike ({100.0 * fit.behind_share:.0f} % behind)"
    sigma = fit.sigma_rad.times(180.0 / math.pi)
    lines = [
        f"bearing sign {sense.sign:+d} (resultant {sense.resultant:.2f}, the other "
        f"{sense.other_resultant:.2f})  {fold}",
        f"{what} {mount.value:+.1f} deg (95 % {_interval(mount, 1)})  bearing sigma "
        f"{sigma.value:.1f} deg  outliers: {100.0 * fit.gross_share:.0f} %  "
        f"field of view {math.degrees(fit.field_of_view_rad):.0f} deg",
    ]
    waves = []
    if fit.waves_rad is not None:
        once, twice = (math.degrees(amplitude) for amplitude in fit.waves_rad)
        waves.append(f"over the angle {once:.1f} deg once, {twice:.1f} deg twice a turn")
    if fit.compass_rad is not None:
        waves.append(f"over the heading (compass) {math.degrees(fit.compass_rad):.1f} deg")
    if waves:
        lines.append(f"waves {', '.join(waves)}")
    if done.bearing_ratio is not None:
        lines.append(_reported("bearing", done.bearing_ratio))
    return lines


def _reported(what: str, ratio: float) -> str:
    return f"the {what} sigma that the radio reports is {ratio:.2f} times the one found"


def _lag_line(done: Calibration) -> str:
    if done.lag_s is None:
        return "lag not determined by this recording; 0 is used"
    return f"lag {done.lag_s.value:.3f} s  (95 % {_interval(done.lag_s, 3)})"


def _interval(figure: Figure, digits: int) -> str:
    return f"{figure.low:.{digits}f} .. {figure.high:.{digits}f}"


def yaml_to_paste(done: Calibration) -> str:
    """Return keys for a radio's `settings` and for `estimation.filter`; empty if none is usable."""
    stage: dict[str, str] = {}
    estimator: dict[str, str] = {}
    if done.has_ranges and done.range_fit is not None:
        stage["range_offset_m"] = f"{done.range_fit.offset_m.value:.2f}"
        stage["range_scale"] = (
            f"{done.range_fit.effective_scale:.4f}" if done.range_fit.is_scale_used else "1.0"
        )
        prior_m = max(_upwards(PRIOR_WIDTHS * done.range_fit.offset_m.half_width), MIN_PRIOR_M)
        estimator["range_sigma_m"] = f"{_upwards(done.range_fit.sigma_m.value):g}"
        estimator["range_offset_sigma_m"] = f"{prior_m:g}"
        estimator["range_offset_min_m"] = f"{-2.0 * prior_m:g}"
        estimator["range_offset_max_m"] = f"{3.0 * prior_m:g}"
    if done.has_bearings and done.bearing_fit is not None:
        _add_bearing_keys(stage, estimator, done.bearing_fit, is_by_north=done.is_by_north)
    if not estimator:
        return ""
    if done.lag_s is not None:
        stage["lag_s"] = f"{min(max(done.lag_s.value, -1.0), 5.0):.3f}"
    if done.range_ratio is not None or done.bearing_ratio is not None:
        estimator["use_reported_sigma"] = "true" if done.keeps_reported_sigma else "false"
    return "\n".join(
        [
            "# input stage",
            *(f"{key}: {value}" for key, value in stage.items()),
            "# estimator",
            *(f"{key}: {value}" for key, value in estimator.items()),
        ]
    )


def _add_bearing_keys(
    stage: dict[str, str], estimator: dict[str, str], fit: BearingFit, *, is_by_north: bool
) -> None:
    mount_deg = math.degrees(fit.mount_rad.value)
    view_deg = math.degrees(fit.field_of_view_rad)
    prior_deg = PRIOR_WIDTHS * math.degrees(fit.mount_rad.half_width)
    if is_by_north:  # nothing rotates these antennas; the filter estimates the offset
        prior_deg = max(prior_deg, abs(mount_deg))
    else:
        stage["bearing_sign"] = f"{fit.sense.sign}"
        if not fit.sense.is_folded:
            stage["bearing_mount_deg"] = f"{mount_deg:.1f}"
        if view_deg < (180.0 if fit.sense.is_folded else WHOLE_DEG):
            stage["field_of_view_deg"] = f"{view_deg:.0f}"
    sigma_deg = _upwards(math.degrees(fit.sigma_rad.value))
    estimator["bearing_sigma_deg"] = f"{min(sigma_deg, 90.0):g}"
    estimator["bearing_offset_sigma_deg"] = f"{max(_upwards(prior_deg), MIN_PRIOR_DEG):g}"
    if fit.sense.is_folded:
        estimator["antenna"] = (
            f"{{kind: line, mount_deg: [0, 0, {mount_deg:.1f}], "
            f"field_of_view_deg: {min(view_deg, 180.0):.0f}}}"
        )


def _upwards(value: float) -> float:
    """Return two significant digits, rounded up; infinity becomes the estimator's own prior, 5."""
    if not value > 0.0:
        return 0.0
    if math.isinf(value):
        return 5.0
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return round(math.ceil(value / step - 1e-9) * step, 12)


def as_json(done: Calibration) -> dict[str, object]:
    """Return everything for `companion.io.files.write_json_atomic`."""
    return {
        "radio": done.radio,
        "emitter_id": done.emitter_id,
        "ranges": done.ranges,
        "bearings": done.bearings,
        "tests": done.tests,
        "usable_ranges": done.has_ranges,
        "usable_bearings": done.has_bearings,
        "refusals": done.refusals,
        "remarks": done.remarks,
        "lag_s": done.lag_s,
        "range": done.range_fit,
        "bearing": done.bearing_fit,
        "is_by_north": done.is_by_north,
        "blocked": done.blocked,
        "range_reported_ratio": done.range_ratio,
        "bearing_reported_ratio": done.bearing_ratio,
        "own_sigma_m": done.own_sigma_m,
        "yaml": yaml_to_paste(done),
    }
