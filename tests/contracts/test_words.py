"""The words that CONTRIBUTING.md asks for: messages, docstrings and documents keep to them."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
PRODUCT = ("sim", "estimators", "experiments", "estima", "tools", "conf", "docs")
TEXTS = [
    *(ROOT / "README.md", CONTRIBUTING),
    *(
        path
        for folder in PRODUCT
        for ending in ("*.py", "*.md", "*.yaml", "*.html")
        for path in sorted((ROOT / folder).rglob(ending))
    ),
]


def house_words():
    """Phrases in the first column of the table of words: those not to write."""
    table = CONTRIBUTING.read_text().partition("## Words")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (.+?) \| .+? \|$", table, re.MULTILINE)[2:]
    return [phrase for row in rows for phrase in row.split(", ")]


def misuse(text):
    """First phrase of a text that the table asks to avoid; None if there is none."""
    phrases = "|".join(re.escape(phrase) for phrase in house_words())
    match = re.search(rf"(?<!here )\b(?:{phrases})\b(?! longer| more)", text)
    return match and match[0]


def test_the_table_is_read():
    assert len(house_words()) > 10
    assert misuse("A grid is no map") == "is no"
    assert misuse("The robot is no longer lost") is None
    assert misuse("There is no such file") is None


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_house_words(path):
    text = path.read_text(encoding="utf-8")
    if path == CONTRIBUTING:
        before, _, rest = text.partition("## Words")
        text = before + rest.partition("\n## ")[2]
    for number, line in enumerate(text.splitlines(), start=1):
        assert misuse(line) is None, f"line {number}: {line.strip()}"
