"""Names for people: of parameters, metrics and values, and how they are set."""

from __future__ import annotations

import re

MU, SIGMA, ETA = "\N{GREEK SMALL LETTER MU}", "\N{GREEK SMALL LETTER SIGMA}", "\u03b7"
PARAMETERS = {
    "sigma_r_m": ("Range noise", SIGMA + "\u1d63", "m"),
    "p_nlos": ("Share of NLOS", "p", ""),
    "mean_bias_m": ("Mean NLOS bias", MU, "m"),
    "step_m": ("Step", ETA, "m"),
    "k_rtt": ("Threshold of ranges", "k", ""),
}
"""Of the paper's tables: name, symbol and unit."""
METRICS = {
    "final_rmse_m": "Final RMSE, m",
    "steps_to_2.5m": "Steps until the RMSE settles below 2.5 m",
    "range_offset_m": "Final estimate of the range offset, m",
    "bound_ratio": "Final RMSE by the Cramer-Rao bound of its own tracks",
    "rmse_ratio": "Final RMSE by that of Proposed with the same planner, same seeds",
    "nees_final": "Mean NEES of the position after the last step",
    "nees_mean": "Mean NEES of the position over steps",
    "coverage_min": "Share of runs whose R95 circle holds the target: least over steps",
    "coverage_mean": "The same: mean over steps",
    "coverage_max": "The same: most over steps",
    "cost_ms_per_step": "Cost of a step, ms",
    "decision_ms": "Of this the decision, ms",
    "filterpy_update_ms": "filterpy's update on the same measurements, ms",
}
"""Titles of tables."""
TYPESET = (
    (r"(?<=\d) to (?=[\d-])", "\u2009\N{EN DASH}\u2009"),
    (r" - ", " \N{EN DASH} "),
    (r"^-$", "\N{EN DASH}"),
    (r"(?<![\w.-])-(?=\d)", "\N{MINUS SIGN}"),
    (r" x (?=\S)", " \N{MULTIPLICATION SIGN} "),
    (r"<=", "\u2264"),
    (r">=", "\u2265"),
    (r"\.\.\.", "\N{HORIZONTAL ELLIPSIS}"),
    (r"(?<=[A-Za-z])'(?=[a-z])", "\N{RIGHT SINGLE QUOTATION MARK}"),
    (r"Cramer-Rao", "Cram\u00e9r\N{EN DASH}Rao"),
    (r"(?<=\d) (?=(m|ms|deg|cm|%|steps?|runs?)\b|%)", "\N{NO-BREAK SPACE}"),
)
"""What is typed, and how it is set."""


def typeset(text: str) -> str:
    """Plain text with the dashes, signs and spaces of print."""
    for pattern, sign in TYPESET:
        text = re.sub(pattern, sign, text)
    return text


def parameter_name(parameter: str) -> str:
    """A parameter with its symbol and unit, for an axis or a heading."""
    if parameter not in PARAMETERS:
        return parameter.replace("_", " ")
    name, symbol, unit = PARAMETERS[parameter]
    return f"{name} {symbol}, {unit}" if unit else f"{name} {symbol}"


def value_name(parameter: str, value: str) -> str:
    """A parameter at one of its values, for example p = 0.5."""
    if parameter not in PARAMETERS:
        return f"{parameter.replace('_', ' ')} {value}"
    _, symbol, unit = PARAMETERS[parameter]
    return f"{symbol} = {value} {unit}".strip()


def metric_name(metric: str) -> str:
    """The title of a metric's table."""
    match = re.fullmatch(r"rmse_after_(\d+)_steps_m", metric)
    if match:
        return f"RMSE after {match[1]} steps, as many as the paper needs to 2.5 m, m"
    return METRICS.get(metric, metric.replace("_", " "))
