"""Tables for papers and pages: LaTeX (booktabs) and Markdown."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}
_LATEX_SPECIAL = re.compile("|".join(re.escape(character) for character in _LATEX))


def plain(value: Any, digits: int = 4) -> str:
    """A cell in words: numbers with so many significant digits, nothing where there is none."""
    if value is None or (isinstance(value, (float, np.floating)) and np.isnan(value)):
        return ""
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if isinstance(value, (float, np.floating)):
        return f"{value:.{digits}g}"
    return str(value)


def to_markdown(frame: pd.DataFrame, digits: int = 4) -> str:
    """Pipe table; columns of numbers are set to the right."""

    def escaped(text: str) -> str:
        return " ".join(text.replace("\\", "\\\\").replace("|", "\\|").split())

    head, rows = _cells(frame, digits, escaped)
    rule = ["---:" if number else "---" for number in _numeric(frame)]
    return "".join(f"| {' | '.join(row)} |\n" for row in (head, rule, *rows))


def to_latex(frame: pd.DataFrame, digits: int = 4) -> str:
    """A `tabular` that needs `booktabs`; numbers such as 1e-05 become powers of ten."""

    def escaped(text: str) -> str:
        power = re.fullmatch(r"(-?[\d.]+)e([+-]\d+)", text)
        if power:
            return rf"${power[1]} \times 10^{{{int(power[2])}}}$"
        if re.fullmatch(r"-[\d.]+", text):
            return f"${text}$"
        return " ".join(_LATEX_SPECIAL.sub(lambda m: _LATEX[m[0]], text).split())

    head, rows = _cells(frame, digits, escaped)
    columns = "".join("r" if number else "l" for number in _numeric(frame))
    lines = [
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        " & ".join(head) + r" \\",
        r"\midrule",
        *(" & ".join(row) + r" \\" for row in rows),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


FORMATS: dict[str, Callable[[pd.DataFrame, int], str]] = {
    "markdown": to_markdown,
    "latex": to_latex,
}
SUFFIXES = {"markdown": ".md", "latex": ".tex"}


def _cells(
    frame: pd.DataFrame, digits: int, escaped: Callable[[str], str]
) -> tuple[list[str], list[list[str]]]:
    """Header and rows as escaped text. Columns are taken one by one: a row would mix types."""
    head = [escaped(str(name)) for name in frame.columns]
    columns = [
        [escaped(plain(value, digits)) for value in frame.iloc[:, i]] for i in range(frame.shape[1])
    ]
    return head, [list(row) for row in zip(*columns, strict=True)]


def _numeric(frame: pd.DataFrame) -> list[bool]:
    """Whether each column holds numbers."""
    return [dtype.kind in "iuf" for dtype in frame.dtypes]
