"""Words of the pages are spelt right."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md")])


def glossary_words() -> set[str]:
    """Return the words of the glossary's terms, which are spelt as intended."""
    text = (ROOT / "docs/glossary.md").read_text(encoding="utf-8")
    terms = re.findall(r"^- \*\*([^*]+)\*\*:", text, re.MULTILINE)
    return {word.lower() for term in terms for word in re.findall(r"\w+", term)}


def test_words_are_spelt_right(tmp_path: Path) -> None:
    known = tmp_path / "words.txt"
    known.write_text("\n".join(sorted(glossary_words())))
    program = Path(sys.executable).with_name("codespell")
    pages = [*map(str, PAGES), str(ROOT / "CHANGELOG.md"), str(ROOT / "CONTRIBUTING.md")]
    command = [str(program), "--ignore-words", str(known), *pages]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.stdout + done.stderr == ""
