"""Kernels compiled ahead: called for arguments they were compiled for, and for no others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion import kernel as module
from companion.estimation.measurement_model import RangingModel
from companion.kernel import frozen, kind_of


def scaled(*arguments: Any) -> str:
    return f"plain, of {len(arguments)}"


VECTOR = ("d", 1, 0x401)
TABLE = {f"{__name__}.scaled": {(VECTOR, "float"): "k0"}}


def compiled_ahead(monkeypatch: pytest.MonkeyPatch) -> Any:
    code = SimpleNamespace(k0=lambda *arguments: f"compiled, of {len(arguments)}")
    monkeypatch.setattr(module, "_native", (code, TABLE))
    return module.kernel(scaled)


def test_arguments_as_compiled_for_are_computed_by_machine_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    call = compiled_ahead(monkeypatch)
    assert call(np.zeros(3), 2.0) == "compiled, of 2"
    assert call(np.zeros(3), np.float64(2.0)) == "compiled, of 2"


@pytest.mark.parametrize(
    "arguments",
    [
        (np.zeros(3), 2),
        (np.zeros(3, np.float32), 2.0),
        (np.zeros((3, 1)), 2.0),
        (np.zeros(6)[::2], 2.0),
        (frozen(np.zeros(3)), 2.0),
        ([0.0], 2.0),
    ],
)
def test_any_others_are_computed_by_the_function_itself(
    monkeypatch: pytest.MonkeyPatch, arguments: tuple[Any, Any]
) -> None:
    assert compiled_ahead(monkeypatch)(*arguments) == "plain, of 2"


def test_a_kernel_that_was_not_compiled_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_native", (SimpleNamespace(), {}))
    assert module.kernel(scaled) is scaled


def test_records_are_reported_by_their_class_and_tuples_by_their_length() -> None:
    model = RangingModel(*range(9))
    assert kind_of(model) == "companion.estimation.measurement_model.RangingModel"
    assert kind_of((1.0, 2.0)) == "tuple 2"
    assert (kind_of(True), kind_of(1)) == ("bool", "int")


@pytest.mark.skipif(not module.IS_SWITCHED_OFF, reason="these tests run compiled")
def test_nothing_that_compiles_is_loaded_where_it_is_switched_off() -> None:
    assert module.numba is None
    assert not module.IS_COMPILED


@pytest.mark.slow
@pytest.mark.parametrize("forgoes", [True, False])
def test_a_process_that_flies_loads_no_compiler(forgoes: bool, tmp_path: Path) -> None:
    pytest.importorskip("numba")
    code = f"""
from companion import kernel_cache
kernel_cache.forgoes_compiler = {forgoes}
import sys, companion.run, companion.kernel as kernel
assert ("numba" in sys.modules or kernel.IS_NATIVE) is not {forgoes}, kernel.IS_NATIVE
assert kernel.IS_COMPILED is not {forgoes}
"""
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "NUMBA_DISABLE_JIT": "0"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
