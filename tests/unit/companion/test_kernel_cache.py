"""Kernels compiled ahead are loaded whole or not at all, and kept where only their user writes."""

from __future__ import annotations

import importlib.util
import logging
import os
import shutil
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

import pytest

from companion import kernel_cache as module
from companion.cli import main
from companion.errors import CompanionError
from companion.kernel_cache import (
    DESCRIPTION,
    KEPT_S,
    PACKAGE,
    cache_folder,
    compile_kernels,
    describe,
    kept,
    load,
)

VARIANTS: module.Variants = {"a.kernel": {(("d", 1, 0x401), "float"): "k0_0"}}


@pytest.fixture(scope="session")
def extension(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An extension module with the name that `companion.kernel_builder` gives it."""
    header = Path(sysconfig.get_path("include")) / "Python.h"
    if shutil.which("cc") is None or not header.exists():
        pytest.skip("needs a C compiler")
    folder = tmp_path_factory.mktemp("extension")
    source, built = folder / "native.c", folder / f"_native{sysconfig.get_config_var('EXT_SUFFIX')}"
    source.write_text(
        '#include <Python.h>\nstatic struct PyModuleDef def = {PyModuleDef_HEAD_INIT, "_native"};\n'
        "PyMODINIT_FUNC PyInit__native(void) { return PyModule_Create(&def); }\n"
    )
    command = ["cc", "-shared", "-fPIC", f"-I{header.parent}", str(source), "-o", str(built)]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("the C compiler does not make extension modules")
    return built


@pytest.fixture
def package(extension: Path, tmp_path: Path) -> Path:
    """A folder as it is kept."""
    folder = tmp_path / "made" / PACKAGE
    folder.mkdir(parents=True)
    shutil.copy(extension, folder)
    describe(folder, VARIANTS)
    return folder


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache, in which nothing is kept yet."""
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "_check_tools", lambda: None)
    return tmp_path / "cache/companion-guidance"


def building(monkeypatch: pytest.MonkeyPatch, package: Path) -> list[Path]:
    """Let a build copy the package; return the folders that it was built in."""
    built: list[Path] = []

    def build(folder: Path) -> None:
        built.append(folder)
        shutil.copytree(package, folder / PACKAGE)

    monkeypatch.setattr(module, "_build", build)
    return built


def test_what_was_described_is_loaded(package: Path) -> None:
    found = load(package)
    assert found is not None
    assert found[1] == VARIANTS


@pytest.mark.parametrize("name", [DESCRIPTION, "_native"])
@pytest.mark.parametrize("damage", ["cut", "changed", "emptied", "missing"])
def test_a_damaged_file_is_not_loaded(package: Path, name: str, damage: str) -> None:
    path = next(package.glob(f"{name}*"))
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        middle = len(data) // 2
        changed = data[:middle] + bytes([255]) * 64 + data[middle + 64 :]
        path.write_bytes({"cut": data[:middle], "changed": changed, "emptied": b""}[damage])
    assert load(package) is None


def test_a_name_that_points_to_another_kernel_is_not_loaded(package: Path) -> None:
    path = package / DESCRIPTION
    path.write_text(path.read_text().replace("k0_0", "k0_1"))
    assert load(package) is None


def test_kernels_of_other_sources_are_left_alone(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "sources_digest", lambda: "of other sources")
    assert load(package) is None


def test_a_build_is_kept_whole_and_not_built_again(
    package: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = building(monkeypatch, package)
    assert kept() is None
    compile_kernels()
    assert kept() is not None
    assert [path.name for path in cache.iterdir()] == [module._kept_folder().name]  # type: ignore[union-attr]
    assert not built[0].exists()


def test_a_damaged_one_is_replaced_and_one_that_another_process_built_first_stays(
    package: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    building(monkeypatch, package)
    compile_kernels()
    folder = module._kept_folder()
    assert folder is not None
    (folder / PACKAGE / DESCRIPTION).write_text("{")
    compile_kernels()
    before = folder.stat().st_ino
    assert kept() is not None
    compile_kernels()
    assert folder.stat().st_ino == before
    assert len(list(cache.iterdir())) == 1


@pytest.mark.usefixtures("cache")
def test_what_another_user_may_have_put_there_is_not_loaded(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    building(monkeypatch, package)
    compile_kernels()
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert kept() is None or os.getuid() == 0


def test_kernels_unused_for_long_are_dropped(
    package: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    building(monkeypatch, package)
    for name in ("ahead-of-before", "kernels-before", "building-before", "debian"):
        (cache / name).mkdir(parents=True)
        os.utime(cache / name, (1.0, 1.0))
    (cache / "ahead-lately").mkdir()
    compile_kernels()
    names = {path.name for path in cache.iterdir()}
    assert names == {"debian", "ahead-lately", module._kept_folder().name}  # type: ignore[union-attr]
    assert KEPT_S > 86400.0


def test_a_build_that_fails_leaves_nothing_and_names_the_last_line(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BUILDER", "companion.no_such_module")
    with pytest.raises(CompanionError, match=r"cannot be compiled: .*no_such_module"):
        compile_kernels()
    assert list(cache.iterdir()) == []


@pytest.mark.usefixtures("cache")
def test_a_cache_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file")
    with pytest.raises(CompanionError, match="set XDG_CACHE_HOME"):
        compile_kernels()


def test_the_services_cache_comes_first_and_without_a_home_there_is_none(
    monkeypatch: pytest.MonkeyPatch, cache: Path
) -> None:
    assert cache_folder() == cache
    monkeypatch.setenv("CACHE_DIRECTORY", "/var/cache/companion")
    assert cache_folder() == Path("/var/cache/companion")
    for name in ("CACHE_DIRECTORY", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name)
    assert cache_folder() is None
    with pytest.raises(CompanionError, match="HOME"):
        compile_kernels()
    assert kept() is None


@pytest.mark.parametrize(
    ("missing", "said"), [("numba", "needs numba: "), ("cc", "sudo apt install gcc python3-dev")]
)
def test_what_is_missing_for_compiling_is_named(
    monkeypatch: pytest.MonkeyPatch, missing: str, said: str
) -> None:
    def found(name: str) -> Any:
        return None if name == missing else "somewhere"

    monkeypatch.setattr(importlib.util, "find_spec", found)
    monkeypatch.setattr(shutil, "which", found)
    with pytest.raises(CompanionError, match=said):
        compile_kernels()


def test_warm_up_that_cannot_compile_says_why_and_that_flights_go_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails() -> None:
        raise CompanionError("compiling needs a C compiler")

    monkeypatch.setattr("companion.run.IS_SWITCHED_OFF", False)
    monkeypatch.setattr(module, "compile_kernels", fails)
    assert main(["warm-up"]) == 1
    lines = capsys.readouterr().err.splitlines()
    lines = [line for line in lines if "compiling kernels" not in line]  # logged by a thread
    assert lines == [
        "companion: compiling needs a C compiler",
        "companion: kernels run as plain Python, which suffices in flight",
    ]


def test_compiling_reports_its_progress(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    import time

    from companion import run

    monkeypatch.setattr(run, "IS_SWITCHED_OFF", False)
    monkeypatch.setattr(run, "PROGRESS_S", 0.01)
    monkeypatch.setattr(module, "compile_kernels", lambda: time.sleep(0.1))
    with caplog.at_level(logging.INFO, logger="companion"):
        assert run.compile_kernels() == "kernels compiled, in 0 s"
    assert caplog.messages[0] == "compiling kernels, which takes half a minute or more"
    assert len(caplog.messages) > 2
