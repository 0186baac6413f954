"""Tables for papers and pages: LaTeX (booktabs) and Markdown."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.runs.row import read_rows
from sim.errors import InputError
from sim.files import write_whole

if TYPE_CHECKING:
    import pandas as pd

_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}
_LATEX_SPECIAL = re.compile("|".join(re.escape(character) for character in _LATEX))


def read_table(path: Path) -> pd.DataFrame:
    """Read any table; texts stay as they are written, whole numbers beside gaps stay whole.

    Raises
    ------
    InputError
        If it is not there, or neither CSV nor Parquet.
    """
    import pandas as pd

    try:
        frame = read_rows(path)
        cells = None
        if path.suffix == ".csv" and path.is_file():
            cells = pd.read_csv(path, dtype="str", keep_default_na=False)
    except (InputError, ValueError) as error:
        why = [*str(error.__cause__ or "no table there").splitlines(), "unreadable"][0].rstrip(".")
        raise InputError(f"{path}: {why}; export-table needs a CSV or Parquet table") from error
    for name, column in list(frame.items()):
        gaps, filled = column.isna(), column.dropna()
        if column.dtype.kind == "f":
            whole = (filled % 1.0 == 0.0) & (filled.abs() < 2.0**53)
            if gaps.any() and len(filled) and whole.all():
                frame[name] = column.astype("Int64")
        if cells is not None and (isinstance(column.dtype, pd.StringDtype) or filled.empty):
            frame[name] = cells[name]  # "NA" is a gap among numbers, but a text among texts
    return frame


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
    for row in (head, *rows):
        if row and row[0].startswith(("[", "*")):  # \\ would take it as its argument
            row[0] = "{}" + row[0]
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


def export(paths: Sequence[Path], form: str, out: Path | None, digits: int) -> None:
    """Do what `estima export-table` does: print tables, or write them to the folder `out`.

    Raises
    ------
    InputError
        If a table cannot be read or shown, or two would become one file.
    """
    if form not in FORMATS:
        raise InputError(f"--format must be {' or '.join(FORMATS)}, got {form!r}")
    sources: dict[str, Path] = {}
    for path in paths:
        name = f"{path.stem}{SUFFIXES[form]}"
        if out is not None and name in sources:
            raise InputError(f"{sources[name]} and {path} would both become {out / name}")
        sources[name] = path
    for path in paths:
        text = FORMATS[form](read_table(path), digits)
        if out is None:
            try:
                print(text)
            except UnicodeEncodeError as error:
                raise InputError(
                    f"{path}: the output's encoding, {error.encoding}, lacks "
                    f"{text[error.start]!a}; write files with -o, or set PYTHONIOENCODING=utf-8"
                ) from error
            continue
        with write_whole(out / f"{path.stem}{SUFFIXES[form]}") as part:
            part.write_text(text, encoding="utf-8")
    if out is not None:
        print(f"{out}: {len(paths)} tables")


def _cells(
    frame: pd.DataFrame, digits: int, escaped: Callable[[str], str]
) -> tuple[list[str], list[list[str]]]:
    """Header and rows as escaped text. Columns are taken one by one: a row would mix types."""
    head = [escaped(str(name)) for name in frame.columns]
    columns = [
        [
            escaped(plain(value, digits))
            for value in column.astype(object).where(column.notna(), None)
        ]
        for column in (frame.iloc[:, i] for i in range(frame.shape[1]))
    ]
    return head, [list(row) for row in zip(*columns, strict=True)]


def _numeric(frame: pd.DataFrame) -> list[bool]:
    """Whether each column holds numbers."""
    return [dtype.kind in "iuf" for dtype in frame.dtypes]
