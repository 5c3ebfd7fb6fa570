"""Kernels that were compiled ahead of the flight: where they are kept, and that they are whole.

A flight loads no compiler, because numba and LLVM take 160 MB of memory. Its kernels are machine
code in a folder `companion_kernels`: next to the program, as in the Debian package, or in the
user's cache, where `companion warm-up` compiles them in a process of its own. Such a folder holds
an extension module and its description, with digests of the sources and of the machine code.
Others' kernels and damaged ones are not loaded; kernels then run as plain Python.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import importlib.machinery
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from companion.errors import CompanionError, how_to_install

PACKAGE, CODE, DESCRIPTION = "companion_kernels", "_native", "description.txt"
Variants = dict[str, dict[tuple[object, ...], str]]
"""Exported names, by kernel and by the kinds of its arguments."""
SOURCES = (
    *("domain.py", "geometry", "estimation", "planning"),
    *("kernel.py", "kernel_builder.py", "warm_up.py"),
)
"""Sources of the compiled code and of its compiler in this package."""
KEPT_S = 30.0 * 86400.0
"""Time for which unused compiled kernels are kept."""
BUILDER = "companion.kernel_builder"

forgoes_compiler = False
"""True in a process that flies, or may: it loads kernels that were compiled ahead, or none."""


def digest_of(root: Path, names: Iterable[str]) -> str:
    """Return a short name for the text of modules, and of all modules in folders, below a root."""
    digest = hashlib.sha256()
    for name in names:
        below = root / name
        for path in [below] if below.suffix else sorted(below.rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


@functools.cache
def sources_digest() -> str:
    """Return a short name for the text of the kernels' sources."""
    return digest_of(Path(__file__).resolve().parent, SOURCES)


def describe(package: Path, variants: Variants) -> None:
    """Write the description of the machine code in a folder."""
    digest = _digest_of(package, variants)
    facts = {"sources": sources_digest(), "digest": digest, "variants": variants}
    (package / DESCRIPTION).write_text(f"{facts!r}\n", encoding="utf-8")


def load(package: Path) -> tuple[Any, Variants] | None:
    """Return machine code and its variants; None if missing, damaged or of other sources."""
    try:
        facts = ast.literal_eval((package / DESCRIPTION).read_text(encoding="utf-8"))
        variants: Variants = facts["variants"]
        digests = (sources_digest(), _digest_of(package, variants))
        if (facts["sources"], facts["digest"]) != digests:
            return None
        name = f"{PACKAGE}.{CODE}"
        loader = importlib.machinery.ExtensionFileLoader(name, str(_code_file(package)))
        spec = importlib.machinery.ModuleSpec(name, loader, origin=loader.path)
        code = importlib.util.module_from_spec(spec)
        loader.exec_module(code)
    except UNREADABLE:
        return None
    return code, variants


UNREADABLE = (OSError, ImportError, LookupError, SyntaxError, TypeError, ValueError, MemoryError)
"""Errors of a file that was damaged."""


def _code_file(package: Path) -> Path:
    return next(iter(sorted(package.glob(f"{CODE}.*"))), package / CODE)


def _digest_of(package: Path, variants: Variants) -> str:
    code = _code_file(package).read_bytes()
    return hashlib.sha256(code + repr(variants).encode()).hexdigest()


def installed() -> tuple[Any, Variants] | None:
    """Return the kernels that are installed with the program; None: none that fit."""
    spec = importlib.util.find_spec(PACKAGE)
    for folder in (spec and spec.submodule_search_locations) or ():
        if (found := load(Path(folder))) is not None:
            return found
    return None


def cache_folder() -> Path | None:
    """Return the folder for compiled kernels: systemd's, XDG's, or the home's; None: neither."""
    environment = os.environ.get
    of_service = environment("CACHE_DIRECTORY", "").partition(":")[0]
    if of_service.startswith("/"):
        return Path(of_service)
    base = environment("XDG_CACHE_HOME", "")
    home = environment("HOME", "")
    if not base.startswith("/"):
        base = f"{home}/.cache" if home.startswith("/") else ""
    return Path(base) / "companion-guidance" if base else None


def _kept_folder() -> Path | None:
    """Return the cache folder for these sources, Python and processor; None without a cache."""
    cache = cache_folder()
    kind = f"{sys.implementation.cache_tag}-{platform.machine()}"
    return None if cache is None else cache / f"ahead-{sources_digest()}-{kind}"


def kept() -> tuple[Any, Variants] | None:
    """Return the kernels in the user's cache; None if absent or owned by another user."""
    folder = _kept_folder()
    with contextlib.suppress(OSError):
        if folder is not None and folder.stat().st_uid in (0, os.geteuid()):
            found = load(folder / PACKAGE)
            with contextlib.suppress(OSError):
                os.utime(folder)
            return found
    return None


def drop_unused(cache: Path) -> None:
    """Delete compiled kernels that were not used for long."""
    for other in cache.iterdir():
        if other.name.startswith(("ahead-", "kernels-", "building-")):
            with contextlib.suppress(OSError):
                if cache.stat().st_mtime - other.stat().st_mtime > KEPT_S:
                    shutil.rmtree(other)


def can_compile() -> bool:
    """Return True if numba is installed, without loading it."""
    return importlib.util.find_spec("numba") is not None


def compile_kernels() -> None:
    """Compile the kernels in another process and keep them, which takes some half a minute.

    Two processes may build at once, the first one's are kept. `CompanionError`: something is
    missing for it, it failed, or nothing can be kept.
    """
    _check_tools()
    folder = _kept_folder()
    if folder is None:
        raise CompanionError("there is no HOME to keep compiled kernels in: set XDG_CACHE_HOME")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        os.utime(folder.parent)
        aside = Path(tempfile.mkdtemp(prefix="building-", dir=folder.parent))
    except OSError as error:
        raise CompanionError(f"{folder.parent}: {error.strerror}; set XDG_CACHE_HOME") from error
    try:
        _build(aside)
        if load(aside / PACKAGE) is None:
            raise CompanionError("the compiled kernels cannot be loaded")
        if load(folder / PACKAGE) is None:
            shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # another process was first
            aside.rename(folder)
        drop_unused(folder.parent)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _check_tools() -> None:
    """Raise an error that names the missing packages."""
    missing = [name for name in ("numba", "setuptools") if not importlib.util.find_spec(name)]
    if missing:
        raise CompanionError(f"compiling needs {missing[0]}: {how_to_install(*missing)}")
    header = Path(sysconfig.get_path("include")) / "Python.h"
    if shutil.which("cc") is None or not header.exists():
        raise CompanionError("compiling needs a C compiler: sudo apt install gcc python3-dev")


def _build(folder: Path) -> None:
    command = (sys.executable, "-W", "ignore", "-m", BUILDER, str(folder))
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise CompanionError(f"the kernels cannot be compiled: {lines[-1]}")
