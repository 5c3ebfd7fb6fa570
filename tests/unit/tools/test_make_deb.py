"""The Debian package: what it brings, in which form, and the same bytes again."""

from __future__ import annotations

import gzip
import itertools
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from companion import __version__
from companion.kernel_cache import DESCRIPTION, PACKAGE, sources_digest
from sim_link.hatch_build import PARSERS, write_manuals
from tools.release import make_deb

needs_dpkg = pytest.mark.skipif(shutil.which("dpkg-deb") is None, reason="dpkg-deb is not here")
needs_bash = pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not here")


def wheels_of_manuals(folder: Path) -> Path:
    """Wheels that have nothing but what the build hook adds."""
    for distribution in PARSERS:
        share = folder / f"{distribution}.data/data/share"
        write_manuals(distribution, __version__, share)
        with zipfile.ZipFile(folder / f"{distribution.replace('-', '_')}-1.whl", "w") as wheel:
            for path in filter(Path.is_file, share.rglob("*")):
                wheel.write(path, path.relative_to(folder))
    return folder


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Lay out all of the package but its wheels, dated long ago."""
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    root = tmp_path / "tree"
    make_deb.lay_out_system(root)
    make_deb.lay_out_documentation(root / "usr/share", wheels_of_manuals(tmp_path))
    make_deb.write_control(root, "amd64")
    return root


def test_configuration_is_kept_by_upgrades(tree: Path) -> None:
    kept = (tree / "DEBIAN/conffiles").read_text().split()
    assert kept == ["/etc/companion/companion.yaml", "/etc/companion/service.env"]
    for name in kept:
        assert (tree / name.removeprefix("/")).is_file()


def test_the_unit_starts_what_the_package_brings(tree: Path) -> None:
    unit = (tree / "lib/systemd/system/companion.service").read_text()
    assert f"ExecStart=/{make_deb.HOME}/bin/companion " in unit
    assert "EnvironmentFile=/etc/companion/service.env" in unit
    assert (tree / "usr/bin/companion").readlink() == Path("/opt/companion/bin/companion")


def test_manuals_have_every_option_and_the_date_of_the_sources(tree: Path) -> None:
    for command, option in (("companion", "signing-key"), ("sim-link", "ready-after")):
        page = gzip.decompress((tree / f"usr/share/man/man1/{command}.1.gz").read_bytes()).decode()
        assert option in page.replace("\\-", "-")
        assert "2023" in page.splitlines()[0]


@needs_bash
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("companion doc", "doctor"),
        ("companion demo --auto", "--autopilot"),
        ("sim-link --se", "--seed"),
    ],
)
def test_bash_completes(tree: Path, words: str, expected: str) -> None:
    command = words.split()[0]
    script = tree / "usr/share/bash-completion/completions" / command
    asked = (
        f"source {script}; COMP_WORDS=({words}); COMP_CWORD={len(words.split()) - 1}; "
        f"_shtab_{command.replace('-', '_')}; echo ${{COMPREPLY[@]}}"
    )
    done = subprocess.run(["bash", "-c", asked], capture_output=True, text=True, check=True)
    assert expected in done.stdout.split()


def run_needs_check(programs: Path, python: str) -> subprocess.CompletedProcess[str]:
    """The check that `make deb` begins with, on a machine with these programs alone."""
    command = ["/bin/sh", str(make_deb.ROOT / "tools/release/check_deb_needs.sh")]
    environment = {"PATH": str(programs), "PYTHON": python}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


def test_a_build_without_what_it_needs_ends_at_once_in_a_line(tmp_path: Path) -> None:
    for name in ("dirname", "strip"):
        (tmp_path / name).symlink_to(shutil.which(name) or f"/usr/bin/{name}")
    done = run_needs_check(tmp_path, "no-python")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("make deb: missing on this machine; sudo apt install gcc g++ libc6-dev ")
    assert "binutils" not in line


def test_the_page_names_the_compilers_and_what_else_a_debian_lacks() -> None:
    page = (make_deb.ROOT / "docs/install.md").read_text()
    (named,) = re.findall(r"^sudo apt install (.*\bmake\b.*)$", page, re.MULTILINE)
    script = (make_deb.ROOT / "tools/release/check_deb_needs.sh").read_text()
    checked = set(re.findall(r"\bneeds ([a-z]\S+) ", script))
    of_others = {"libc6-dev", "binutils", "dpkg"}  # g++ depends on two of them, Debian on the third
    assert set(named.split()) == {"make"} | checked - of_others


def test_the_date_of_a_build_asks_git_only_if_none_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    monkeypatch.setenv("PATH", str(tmp_path))
    laid_out: list[str] = []
    monkeypatch.setattr(sys, "argv", ["make_deb.py"])
    monkeypatch.setattr(make_deb, "ROOT", tmp_path)
    for part in ("lay_out_environment", "lay_out_system", "lay_out_documentation"):
        monkeypatch.setattr(make_deb, part, lambda *_, part=part: laid_out.append(part))
    monkeypatch.setattr(make_deb, "write_control", lambda *_: None)
    monkeypatch.setattr(make_deb, "build", lambda *_: tmp_path)
    assert make_deb.main() == 0
    assert len(laid_out) == 3


@pytest.mark.parametrize("sources", ["of other sources", sources_digest()])
def test_kernels_of_other_sources_are_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sources: str
) -> None:
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    kernels = tmp_path / f"build/kernels/{version}" / PACKAGE
    kernels.mkdir(parents=True)
    (kernels / DESCRIPTION).write_text(f"{{'sources': {sources!r}}}\n")
    compiled: list[str] = []
    monkeypatch.setattr(make_deb, "ROOT", tmp_path)
    monkeypatch.setattr(subprocess, "run", lambda command, **_: compiled.append(command[-1]))
    assert make_deb.kernels_for(version, tmp_path) == kernels
    assert compiled == ([] if sources == sources_digest() else [str(kernels.parent)])


def test_scripts_and_headers_of_wheels_are_left_out(tmp_path: Path) -> None:
    wheel = tmp_path / "part-1-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("part/__init__.py", "")
        archive.writestr("part-1.data/scripts/part.py", "")
    make_deb.unpack(wheel, tmp_path / "site")
    assert [path.name for path in (tmp_path / "site").iterdir()] == ["part"]


@needs_dpkg
def test_dpkg_orders_candidates_before_their_release() -> None:
    order = ["0.2.0", "1.0.0a1", "1.0.0rc1", "1.0.0rc2", "1.0.0", "1.0.1rc1"]
    debian = [make_deb.debian_version(version) for version in order]
    assert debian[2] == "1.0.0~rc1"
    for earlier, later in itertools.pairwise(debian):
        subprocess.run(["dpkg", "--compare-versions", earlier, "lt", later], check=True)


@needs_dpkg
def test_two_builds_are_the_same_bytes(tree: Path, tmp_path: Path) -> None:
    first = make_deb.build(tree, tmp_path / "first", "amd64").read_bytes()
    for path in tree.rglob("*"):
        if not path.is_symlink():
            os.utime(path)
            path.chmod(0o775 if path.is_dir() or path.stat().st_mode & 0o100 else 0o600)
    assert make_deb.build(tree, tmp_path / "second", "amd64").read_bytes() == first


@needs_dpkg
def test_dpkg_reads_what_the_package_says_of_itself(tree: Path, tmp_path: Path) -> None:
    package = make_deb.build(tree, tmp_path, "amd64")
    fields = ["dpkg-deb", "--field", str(package), "Package", "Version", "Architecture"]
    said = subprocess.run(fields, capture_output=True, text=True, check=True).stdout
    assert said.splitlines() == [
        "Package: companion-guidance",
        f"Version: {make_deb.debian_version(__version__)}",
        "Architecture: amd64",
    ]
    listed = subprocess.run(
        ["dpkg-deb", "--contents", str(package)], capture_output=True, text=True, check=True
    ).stdout
    assert {line.split()[1] for line in listed.splitlines()} == {"root/root"}
