"""Parts of a release: a CycloneDX list, their licences, and known vulnerabilities.

    make dist && .venv/bin/python tools/release/list_parts.py [--vulnerability-service osv]

Installs the wheels of dist/ with the pinned versions of packaging/constraints.txt into an
environment of their own, as the Debian package has them, and writes the installed parts to
dist/companion-guidance.cdx.json and dist/LICENCES.txt. Exit code 1 if pip-audit knows a
vulnerability, or cannot ask. Options are those of pip-audit.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.entry import ignore_broken_pipe
from tools.release.make_deb import EXTRAS, PACKAGING, ROOT

DIST = ROOT / "dist"
PARTS = DIST / "companion-guidance.cdx.json"
LICENCES = DIST / "LICENCES.txt"
ENVIRONMENT = ROOT / "build/parts"


def main() -> int:
    """Write both lists, then ask for vulnerabilities."""
    python = ENVIRONMENT / "bin/python"
    run(sys.executable, "-m", "venv", "--without-pip", "--clear", ENVIRONMENT)
    files = (f"--find-links={DIST}", f"--constraint={PACKAGING / 'constraints.txt'}")
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", *files, *EXTRAS)
    beside = Path(sys.executable).parent
    options = ("--output-reproducible", "--pyproject", ROOT / "pyproject.toml")
    run(beside / "cyclonedx-py", "environment", *options, "--output-file", PARTS, python)
    parts = json.loads(PARTS.read_text())["components"]
    lines = sorted(f"{part['name']} {part['version']}: {licence_of(part)}" for part in parts)
    LICENCES.write_text("\n".join(lines) + "\n")
    print(f"{PARTS}: {len(parts)} parts\n{LICENCES}")
    (packages,) = ENVIRONMENT.glob("lib/python3.*/site-packages")
    return audit(beside / "pip-audit", packages, sys.argv[1:])


def audit(program: Path, packages: Path, options: Sequence[str] = ()) -> int:
    """Print known vulnerabilities; return 1 if there are any or the query failed."""
    command = [str(program), "--path", str(packages), "--progress-spinner=off", "--format=json"]
    asked = subprocess.run([*command, *options], check=False, capture_output=True, text=True)
    if not asked.stdout:
        print(f"not looked up: {(asked.stderr.splitlines() or ['pip-audit says nothing'])[-1]}")
        return 1
    parts = json.loads(asked.stdout)["dependencies"]
    others = [part for part in parts if not part["name"].startswith("companion-")]
    unknown = [part["name"] for part in others if "skip_reason" in part]
    weak = [part for part in others if part.get("vulns")]
    for part in weak:
        names = ", ".join(weakness["id"] for weakness in part["vulns"])
        print(f"{part['name']} {part['version']}: {names}")
    if unknown:
        print(f"not looked up, unknown to the package index: {', '.join(unknown)}")
    print(f"{len(others) - len(unknown)} parts looked up, {len(weak)} with known weaknesses")
    return int(bool(weak or unknown))


def run(*command: str | Path) -> None:
    """Run a command; raises an error if it fails."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([str(word) for word in command], check=True, env=environment)


def licence_of(part: dict[str, Any]) -> str:
    """Return the licence from a part's metadata: an expression, identifiers, or names."""
    found = []
    for entry in part.get("licenses", ()):
        licence = entry.get("license", {})
        name = entry.get("expression") or licence.get("id") or licence.get("name")
        found += str(name).splitlines()[:1] if name else []
    return " AND ".join(dict.fromkeys(found)) or "not stated"


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
