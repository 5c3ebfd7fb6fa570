"""Pages are plain: short sentences, words spelt right, texts of the program as it says them."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md")])
MOST_WORDS = 18.0
"""Of a page's sentences on average."""
LONGER: dict[str, float] = {}
"""Pages that are not plain yet, and what they have; only ever lowered, or taken off."""
LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
CODE = re.compile(r"`[^`]*`")
END = re.compile(r"(?<=[.!?])[\s*)\"]+(?=[A-Z*\"(])|\n\s*\n|\n *(?:[-*]|\d+\.) (?:\[.\] )?")
"""Where a sentence or an item of a list ends; a colon or a semicolon ends nothing."""


def sentences_of(text: str) -> list[str]:
    """The sentences of a page: no code, no tables; code within a line is one word."""
    fences = re.compile(r"^ *```.*?^ *```$", re.DOTALL | re.MULTILINE)
    plain = re.sub(r"^ *(?:\||!\[|:::|#).*$", "", fences.sub("", text), flags=re.MULTILINE)
    plain = CODE.sub("Code", LINK.sub(r"\1", plain))
    parts = [part.strip(" #*-\n") for part in END.split(f"\n{plain}")]
    return [part for part in parts if len(part.split()) > 2]


def mean_words(page: Path) -> float:
    found = sentences_of(page.read_text(encoding="utf-8"))
    return sum(len(each.split()) for each in found) / max(1, len(found))


def test_sentences_are_told_apart() -> None:
    text = "# A title here\n\nOne two: three. Four `five six` seven eight.\n\n- a b c\n- d e f g\n"
    assert [len(each.split()) for each in sentences_of(text)] == [3, 4, 3, 4]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_sentences_are_short(page: Path) -> None:
    name = str(page.relative_to(ROOT))
    assert mean_words(page) <= LONGER.get(name, MOST_WORDS)


def test_a_page_that_became_plain_is_taken_off_the_list() -> None:
    assert [name for name in LONGER if mean_words(ROOT / name) <= MOST_WORDS] == []


def glossary_words() -> set[str]:
    """What the glossary explains is spelt as it is meant."""
    text = (ROOT / "docs/glossary.md").read_text(encoding="utf-8")
    terms = re.findall(r"^\| ([^|]+) \|", text, re.MULTILINE)
    return {word.lower() for term in terms for word in re.findall(r"\w+", term)}


def test_words_are_spelt_right(tmp_path: Path) -> None:
    known = tmp_path / "words.txt"
    known.write_text("\n".join(sorted(glossary_words())))
    program = Path(sys.executable).with_name("codespell")
    pages = [*map(str, PAGES), str(ROOT / "CHANGELOG.md"), str(ROOT / "CONTRIBUTING.md")]
    command = [str(program), "--ignore-words", str(known), *pages]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.stdout + done.stderr == ""


def test_the_safety_page_has_the_texts_of_the_list_of_all_texts() -> None:
    listed = set(
        re.findall(r"^\| `([^`]+)` \|", (ROOT / "docs/messages.md").read_text(), re.MULTILINE)
    )
    rows = re.findall(
        r"^\| [^|]+ \| `([^`]+)` \|", (ROOT / "docs/safety.md").read_text(), re.MULTILINE
    )
    assert len(rows) >= 18
    assert set(rows) - listed == set()
