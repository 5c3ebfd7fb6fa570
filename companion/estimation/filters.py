"""The recursive filters by name."""

from __future__ import annotations

from typing import Literal

from companion.estimation.admm_ekf import AdmmEkf
from companion.estimation.asymmetric_huber_ekf import AsymmetricHuberEkf
from companion.estimation.ekf import Ekf
from companion.estimation.filter_params import FilterParams
from companion.estimation.huber_ekf import HuberEkf
from companion.estimation.recursive_filter import RecursiveFilter

FilterKind = Literal["asymmetric_huber", "huber", "admm", "ekf"]

KINDS: dict[FilterKind, type[RecursiveFilter]] = {
    "asymmetric_huber": AsymmetricHuberEkf,
    "huber": HuberEkf,
    "admm": AdmmEkf,
    "ekf": Ekf,
}


def filter_of(kind: FilterKind, params: FilterParams) -> RecursiveFilter:
    """The filter of that name; its `params` are those in force, thresholds included."""
    return KINDS[kind](params)
