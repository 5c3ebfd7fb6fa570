from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from sim_link.lab.evaluation.case import Case
from sim_link.lab.evaluation.study_run import FILE_NAME, key_of, opened
from sim_link.lab.evaluation.systems import System


def test_what_was_kept_is_found_again(tmp_path: Path) -> None:
    with opened(tmp_path / FILE_NAME) as store:
        store.keep("a", b"one")
        store.keep("b", b"two")
        store.keep("a", b"three")
    with opened(tmp_path / FILE_NAME) as store:
        assert store.found(["a", "b", "c"]) == {"a": b"three", "b": b"two"}


def test_more_keys_than_one_query_holds(tmp_path: Path) -> None:
    keys = [str(number) for number in range(1203)]
    with opened(tmp_path / FILE_NAME) as store:
        for key in keys:
            store.keep(key, key.encode())
        assert store.found(keys) == {key: key.encode() for key in keys}


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
    path = tmp_path / FILE_NAME
    path.write_text("dear diary, " * 100)
    with pytest.raises(ConfigError, match="delete it, or choose another --out"), opened(path):
        pass
    assert path.read_text().startswith("dear diary")
