"""Prints the mean NLOS bias by the paper's EM and by the corrected one, case by case."""

from __future__ import annotations

import itertools

import numpy as np

from companion.entry import ignore_broken_pipe
from tools.console import OneLineParser
from tools.study.noise_adaptation import RangeNoise
from tools.study.printed_adaptation import BiasComparison, compare_mean_bias

MEAN_BIASES_M = (2.0, 5.0, 8.0, 15.0)
SIGMAS_M = (0.5, 1.5, 2.5)
SHARES = (1.0, 0.9, 0.3)
START = RangeNoise(sigma_m=1.5, mean_bias_m=5.0, nlos_share=0.5)

HEADER = (
    "         truth        |        paper's EM (given sigma)       |"
    "       corrected (given none)\n"
    "  mean b  sigma     p |   limit    found    error  collapsed  |"
    "   found   +-run    error   sigma     p"
)


def main() -> None:
    """Print a row for each case."""
    parser = OneLineParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10, help="draws per case")
    parser.add_argument("--samples", type=int, default=1000, help="residuals per draw")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    cases = list(itertools.product(SHARES, SIGMAS_M, MEAN_BIASES_M))
    print(f"{arguments.runs} runs of {arguments.samples} residuals, seed {arguments.seed}; metres")
    print(HEADER)
    seeds = np.random.SeedSequence(arguments.seed).spawn(len(cases))
    for seed, (share, sigma_m, mean_bias_m) in zip(seeds, cases, strict=True):
        truth = RangeNoise(sigma_m, mean_bias_m, share)
        rng = np.random.default_rng(seed)
        print(row(compare_mean_bias(truth, START, arguments.samples, arguments.runs, rng)))


def row(case: BiasComparison) -> str:
    """Return the results of the printed and of the corrected equations for a case."""
    truth, found = case.truth, case.corrected
    return (
        f"{truth.mean_bias_m:8.1f}{truth.sigma_m:7.1f}{truth.nlos_share:6.1f} |"
        f"{case.printed_limit_m:8.2f}{case.printed_m:9.2f}"
        f"{case.printed_m - truth.mean_bias_m:+9.2f}{case.collapsed_share:10.0%}   |"
        f"{found.mean_bias_m:8.2f}{case.corrected_spread_m:8.2f}"
        f"{found.mean_bias_m - truth.mean_bias_m:+9.2f}{found.sigma_m:8.2f}{found.nlos_share:6.2f}"
    )


if __name__ == "__main__":
    ignore_broken_pipe()
    main()
