"""Builds the Debian package: `make deb`, or tools/release/make_deb.py --architecture arm64.

A virtual environment is a folder with a pyvenv.cfg, a link to the system's Python and
lib/pythonX.Y/site-packages. The package holds one that is laid out here, with such a folder for
each Python of Debian 12 and 13: binary wheels of the pinned versions are unpacked, not built, so
that one machine makes the packages of every architecture, and installing neither downloads nor
compiles. The same sources and SOURCE_DATE_EPOCH (the last commit's time by default) give the same
bytes.

The kernels are compiled ahead by `companion.kernel_builder`, once for each state of the
sources, if an interpreter of the version is installed and the architecture is this machine's.
Otherwise they run as plain Python, which a line on stderr reports.

Needs dpkg-deb, a C compiler, and the package index for wheels that pip does not have in its cache.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

from companion import __version__
from companion.entry import ignore_broken_pipe
from companion.kernel_cache import BUILDER, DESCRIPTION, sources_digest

ROOT = Path(__file__).resolve().parents[2]
PACKAGING = ROOT / "packaging"
PYTHONS = ("3.11", "3.13")
"""Debian 12 and Raspberry Pi OS of 2023; Debian 13 and Raspberry Pi OS of 2025."""
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
GLIBCS = ("_2_28", "_2_27", "_2_26", "_2_17", "_2_12", "_2_5", "2014", "2010", "1")
"""Versions of glibc, or years, that accepted wheels may name: Debian 12 has 2.36."""
EXTRAS = (
    f"companion-guidance[mcap]=={__version__}",
    f"companion-sim-link=={__version__}",
    "rich",
)
COMMANDS = {
    "companion": "companion.entry",
    "sim-link": "sim_link.cli",
    "companion-conformance": "sim_link.lab.conformance.cli",
}
FILES = {
    "companion.sysusers": "usr/lib/sysusers.d/companion.conf",
    "60-companion.rules": "usr/lib/udev/rules.d/60-companion.rules",
    "service.env": "etc/companion/service.env",
}
CONFFILES = ("etc/companion/companion.yaml", "etc/companion/service.env")
HOME = Path("opt/companion")
SHARED = HOME / "lib/shared"
"""Folder that every Python reads: wheels without compiled modules, and the presets."""


def main() -> int:
    """Build one package and print its path."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--architecture", choices=tuple(MACHINES), default=native_architecture())
    parser.add_argument("--wheels", type=Path, default=ROOT / "dist", help="those of this project")
    parser.add_argument("--output", type=Path, default=ROOT / "dist")
    options = parser.parse_args()
    if "SOURCE_DATE_EPOCH" not in os.environ:
        command = ("git", "-C", str(ROOT), "log", "-1", "--format=%ct")
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        os.environ["SOURCE_DATE_EPOCH"] = done.stdout.strip()
    work = ROOT / "build/deb" / options.architecture
    tree = work / "tree"
    shutil.rmtree(tree, ignore_errors=True)
    lay_out_environment(tree, options.architecture, options.wheels, work / "wheels")
    lay_out_system(tree)
    lay_out_documentation(tree / "usr/share", options.wheels)
    write_control(tree, options.architecture)
    print(build(tree, options.output, options.architecture))
    return 0


def native_architecture() -> str:
    """Return the architecture by dpkg's name."""
    machine = os.uname().machine
    return next((name for name, known in MACHINES.items() if known == machine), "amd64")


def debian_version(version: str) -> str:
    """Return the version in dpkg's order: a candidate comes before its release."""
    return re.sub(r"(?<=\d)(a|b|rc)(?=\d+$)", r"~\1", version)


def lay_out_environment(tree: Path, architecture: str, own: Path, cache: Path) -> None:
    """Lay out the virtual environment with its commands, and the wheels of each Python."""
    binaries = tree / HOME / "bin"
    binaries.mkdir(parents=True)
    (binaries / "python3").symlink_to("/usr/bin/python3")
    settings = "home = /usr/bin\ninclude-system-site-packages = false\n"
    (tree / HOME / "pyvenv.cfg").write_text(settings)
    for version in PYTHONS:
        folder = tree / HOME / f"lib/python{version}/site-packages"
        folder.mkdir(parents=True)
        (folder / "shared.pth").write_text(f"/{SHARED}\n")
        kernels = kernels_for(version, own) if architecture == native_architecture() else None
        if kernels is None:
            print(f"make_deb: Python {version} gets kernels in plain Python", file=sys.stderr)
        else:
            shutil.copytree(kernels, folder / kernels.name)
        for wheel in fetch_wheels(version, architecture, own, cache / version):
            is_pure = wheel.name.endswith("-none-any.whl")
            unpack(wheel, tree / SHARED if is_pure else folder)
    for command, module in COMMANDS.items():
        script = binaries / command
        script.write_text(
            f"#!/{HOME}/bin/python3\nimport sys\n\nfrom {module} import main\n\nsys.exit(main())\n"
        )
        script.chmod(0o755)
    shutil.copytree(ROOT / "configs", tree / SHARED / "configs")
    (tree / HOME / "configs").symlink_to("lib/shared/configs")


def kernels_for(version: str, own: Path) -> Path | None:
    """Return the compiled kernels for a Python, built unless they match these sources and tool."""
    is_this = sys.version.startswith(f"{version}.")
    program = sys.executable if is_this else other_python(version)
    kernels = ROOT / f"build/kernels/{version}/companion_kernels"
    described = kernels / DESCRIPTION
    if described.exists() and sources_digest() in described.read_text():
        return kernels
    if program is None:
        return None
    shutil.rmtree(kernels, ignore_errors=True)
    if not is_this:
        program = environment_for(program, version, own)
    # objects are named and sorted by their addresses, too: those must be the same each time
    fixed_addresses = ("setarch", "--addr-no-randomize") if shutil.which("setarch") else ()
    command = (*fixed_addresses, program, "-W", "ignore", "-m", BUILDER, str(kernels.parent))
    fixed = {"PYTHONPATH": str(ROOT), "PYTHONHASHSEED": "0"}
    subprocess.run(command, check=True, env={**os.environ, **fixed})
    return kernels


def other_python(version: str) -> str | None:
    """Return another version's interpreter on the path, if it starts; or None."""
    program = shutil.which(f"python{version}")
    if program is None or subprocess.run([program, "-c", ""], check=False).returncode != 0:
        return None
    return program


def environment_for(program: str, version: str, own: Path) -> str:
    """Return the interpreter of an environment of another Python, with the tools for compiling."""
    folder = ROOT / f"build/kernels/python{version}"
    python = str(folder / "bin/python")
    subprocess.run([program, "-m", "venv", "--clear", str(folder)], check=True)
    files = (f"--find-links={own}", f"--constraint={PACKAGING / 'constraints.txt'}")
    wanted = (f"companion-guidance=={__version__}", "numba", "setuptools")
    pip = (python, "-m", "pip", "install", "--quiet", *files, *wanted)
    subprocess.run(pip, check=True)
    return python


def fetch_wheels(version: str, architecture: str, own: Path, folder: Path) -> list[Path]:
    """Return binary wheels of the pinned versions; pip caches its downloads."""
    shutil.rmtree(folder, ignore_errors=True)
    platforms = [f"--platform=manylinux{libc}_{MACHINES[architecture]}" for libc in GLIBCS]
    options = ["--only-binary=:all:", "--implementation=cp", f"--python-version={version}"]
    files = [f"--find-links={own}", f"--constraint={PACKAGING / 'constraints.txt'}"]
    pip = [sys.executable, "-m", "pip", "download", "--quiet", f"--dest={folder}"]
    subprocess.run([*pip, *options, *platforms, *files, *EXTRAS], check=True)
    return sorted(folder.glob("*.whl"))


def unpack(wheel: Path, folder: Path) -> None:
    """Unpack a wheel's modules; its scripts and headers are not needed."""
    with zipfile.ZipFile(wheel) as archive:
        members = [name for name in archive.namelist() if ".data/" not in name]
        archive.extractall(folder, members)


def lay_out_system(tree: Path) -> None:
    """Lay out unit, user, udev rule, conffiles and the commands on the path."""
    for source, target in FILES.items():
        put(PACKAGING / "debian" / source, tree / target)
    put(ROOT / "configs/companion/default.yaml", tree / "etc/companion/companion.yaml")
    put(ROOT / "configs/systemd/companion.service", tree / "lib/systemd/system/companion.service")
    (tree / "usr/bin").mkdir(parents=True)
    for command in COMMANDS:
        (tree / "usr/bin" / command).symlink_to(f"/{HOME}/bin/{command}")


def put(source: Path | zipfile.Path, target: Path) -> None:
    """Copy a file and make its folders."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(source.read_bytes())


def lay_out_documentation(share: Path, wheels: Path) -> None:
    """Copy man pages and completions of the project's wheels; changelog and licence."""
    for wheel in sorted(wheels.glob("companion_*.whl")):
        with zipfile.ZipFile(wheel) as archive:
            for name in archive.namelist():
                path = name.partition(".data/data/share/")[2]
                if path.startswith("man/"):
                    compress(archive.read(name).decode(), share / f"{path}.gz")
                elif path:
                    put(zipfile.Path(archive, name), share / path)
    documents = share / "doc/companion-guidance"
    put(ROOT / "LICENSE", documents / "copyright")
    compress((ROOT / "CHANGELOG.md").read_text(), documents / "changelog.gz")


def compress(text: str, target: Path) -> None:
    """Write a gzip file without a timestamp."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(gzip.compress(text.encode(), mtime=0))


def write_control(tree: Path, architecture: str) -> None:
    """Write the package's control files and the sums of all others, sorted by name."""
    folder = tree / "DEBIAN"
    files = sorted(path for path in tree.rglob("*") if path.is_file() and not path.is_symlink())
    size_kb = sum(-(-path.stat().st_size // 1024) for path in files)
    folder.mkdir()
    control = (PACKAGING / "debian/control").read_text()
    for name, value in (
        ("VERSION", debian_version(__version__)),
        ("ARCHITECTURE", architecture),
        ("SIZE_KB", size_kb),
    ):
        control = control.replace(f"@{name}@", str(value))
    (folder / "control").write_text(control)
    (folder / "conffiles").write_text("".join(f"/{name}\n" for name in CONFFILES))
    sums = (
        f"{hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest()}  "
        f"{path.relative_to(tree)}\n"
        for path in files
    )
    (folder / "md5sums").write_text("".join(sums))
    for script in ("postinst", "prerm", "postrm"):
        put(PACKAGING / "debian" / script, folder / script)
        (folder / script).chmod(0o755)


def build(tree: Path, output: Path, architecture: str) -> Path:
    """Pack the tree, independently of the umask and the user of this machine."""
    for path in [tree, *tree.rglob("*")]:
        if not path.is_symlink():
            is_run = path.is_dir() or path.stat().st_mode & 0o100
            path.chmod(0o755 if is_run else 0o644)
    output.mkdir(parents=True, exist_ok=True)
    package = output / f"companion-guidance_{debian_version(__version__)}_{architecture}.deb"
    command = ["dpkg-deb", "--root-owner-group", "-Zxz", "--build", str(tree), str(package)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return package


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
