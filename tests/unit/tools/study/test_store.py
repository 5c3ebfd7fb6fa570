from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import CompanionError, ConfigError
from tools.study.case import Case
from tools.study.study_run import FOLDER_NAME, Store, key_of
from tools.study.systems import System


def test_what_was_kept_is_found_again(tmp_path: Path) -> None:
    store = Store(tmp_path / FOLDER_NAME)
    store.keep("a", b"one")
    store.keep("b", b"two")
    store.keep("a", b"three")
    assert Store(tmp_path / FOLDER_NAME).found(["a", "b", "c"]) == {"a": b"three", "b": b"two"}


def test_the_key_names_all_that_a_result_follows_from() -> None:
    system = System("ekf", "fim")
    keys = {
        key_of(Case(), system, 1, "a"),
        key_of(Case(), system, 2, "a"),
        key_of(Case(), system, 1, "b"),
        key_of(Case(step_m=4.0), system, 1, "a"),
        key_of(Case(), System("ekf", "passive"), 1, "a"),
    }
    assert len(keys) == 5
    assert key_of(Case(), system, 1, "a") in keys


def test_another_file_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / FOLDER_NAME
    path.write_text("dear diary")
    with pytest.raises(ConfigError, match="delete it, or choose another --out"):
        Store(path)
    assert path.read_text() == "dear diary"


def test_a_result_that_cannot_be_kept_or_read_is_one_line(tmp_path: Path) -> None:
    store = Store(tmp_path / FOLDER_NAME)
    (tmp_path / FOLDER_NAME / "a").mkdir()
    with pytest.raises(CompanionError, match="cannot be written"):
        store.keep("a", b"one")
    with pytest.raises(CompanionError, match="a: "):
        store.found(["a"])
