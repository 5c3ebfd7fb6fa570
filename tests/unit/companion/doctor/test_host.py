"""Facts that the doctor collects of this computer."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from companion.config.schema import CompanionConfig
from companion.doctor.examination import inspect_folder, inspect_host, inspect_link
from companion.errors import LinkError
from companion.io.links.transports import UdpConnect
from companion.io.state_directory import VehicleLock, resolved_address
from companion.run import link_name


def test_a_place_is_written_to_and_left_as_it_was(tmp_path: Path) -> None:
    folder = inspect_folder(tmp_path / "flights")
    assert folder.problem is None
    assert folder.free_mb is not None
    assert folder.free_mb > 0.0
    assert folder.synced_write_s is not None
    assert os.listdir(tmp_path / "flights") == []


def test_a_place_that_cannot_be_is_reported_as_text(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    folder = inspect_folder(tmp_path / "file" / "flights")
    assert folder.problem == "Not a directory"
    assert folder.free_mb is None


def test_a_key_that_others_may_read_is_reported(tmp_path: Path) -> None:
    key = tmp_path / "signing.key"
    key.write_text("ab" * 32)
    key.chmod(0o644)
    host = inspect_host(tmp_path, tmp_path, str(key))
    assert host.has_key
    assert host.key_problem is not None
    assert "chmod 600" in host.key_problem
    assert "abab" not in host.key_problem
    key.chmod(0o600)
    assert inspect_host(tmp_path, tmp_path, str(key)).key_problem is None


def test_a_vehicle_that_a_companion_flies_is_left_alone(tmp_path: Path) -> None:
    link = UdpConnect("localhost", 14580)
    lock = VehicleLock(tmp_path, link_name(link), None, resolved_address(link))
    with pytest.raises(LinkError, match="another companion"):
        inspect_link(CompanionConfig(), link, 0.1, tmp_path, can_sign=False)
    lock.release()


def test_this_computer_is_known(tmp_path: Path) -> None:
    host = inspect_host(tmp_path, tmp_path, None)
    assert host.python >= (3, 11, 0)
    assert host.numpy[0].isdigit()
    assert not host.has_key
