"""The table of a sweep, shown and written: text, Markdown, LaTeX, HTML, CSV, Parquet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from markupsafe import Markup, escape

from experiments.report.export import (
    TEXT_PT,
    Form,
    escape_markdown,
    fold_intervals,
    latex,
    numeric_columns,
    to_latex,
    to_markdown,
    written,
)
from experiments.report.page import render
from experiments.runs.columns import ANSWER, PATH
from experiments.runs.console import pluralize
from experiments.runs.row import Outcome, write_frame
from experiments.sweeps.summary import BELOW, COUNT_WORDS, COUNTS, ERROR, MARKS, summary
from experiments.sweeps.winner import find_winner
from sim.errors import require
from sim.files import write_text

DIGITS = 3
FORMATS = (".tex", ".md", ".html", ".csv", ".parquet")
# Of the text of LaTeX's article, and of IEEE's two-column papers
WIDTHS_PT = {"text": TEXT_PT, "column": 252.0, "page": 516.0}
HTML = Form(
    lambda text: str(escape(text)),
    "<b>{}</b>",
    "<sup>*</sup>",
    ' <span class="whole">[{}, {}]</span>',
)


WORDS = {
    Outcome.OK: "ran to the end",
    Outcome.REMARK: "ran, with a remark",
    Outcome.FAILED: "failed",
}
_MOST_REMARKS = 12


def check_name(path: Path | None, size: str | None) -> None:
    """Check that a table's file has an ending that names its format, and a LaTeX one's size."""
    if path is not None:
        require(path.suffix in FORMATS, f"{path}: a table is {', '.join(FORMATS)}")
    if size is not None:
        require(size in WIDTHS_PT, f"the size must be {', '.join(WIDTHS_PT)}, got {size}")
        require(path and path.suffix == ".tex", f"size {size} is for a file such as x.tex")


_TESTED = 6  # runs below which a paired test finds next to nothing


def notes(found: pd.DataFrame, against: str | None) -> str:
    """How the numbers of a summary came about and what the marks mean, in a line."""
    best, differs = (found.filter(regex=f"_{mark}$").to_numpy(bool).any() for mark in MARKS)
    parts = [f"{found.attrs['rule']}."]
    if best:
        parts.append("Bold: the best on the same recordings.")
    if found["incomplete"].any():
        parts.append("incomplete: runs without a pose for some of the drive, never the best.")
    if found["with_remarks"].any():
        parts.append("With remarks: a method gave a warning, which the sweep's page names.")
    if differs:
        parts.append(
            f"*: differs from {against} (paired t tests over recordings; 5 % for the table, Holm)."
        )
    elif against:
        few = "; so few recordings show large differences only"
        few *= bool(found["runs"].max() < _TESTED)
        parts.append(f"Nothing differs from {against} by paired tests{few}.")
    if against:
        parts.append("The interval of a ratio holds 95 % by itself, without Holm's correction.")
    if BELOW in found:
        parts.append("Over bound: pooled RMS over the least of any method, by simulation's laws.")
        if found[BELOW].any():
            parts.append("Below bound: such errors take what the method should not see.")
    return " ".join(parts)


def shown(found: pd.DataFrame) -> pd.DataFrame:
    """A summary with a cell a mean, and without columns that say nothing."""
    silent = [name for name in (*COUNTS, BELOW) if name in found and not found[name].any()]
    silent += [PATH] if (found[PATH] == "online").all() else []
    return fold_intervals(found.drop(columns=silent)).rename(columns=COUNT_WORDS)


def as_lines(found: pd.DataFrame, note: str) -> str:
    """The table for a terminal, where `>` stands for bold."""
    cells = written(shown(found), Form(str, ">{}", "*"), DIGITS)
    return f"{note.replace('Bold:', '>:')}\n\n{cells.to_string(index=False)}"


def write_table(
    found: pd.DataFrame, note: str, path: Path, name: str, size: str | None = None
) -> None:
    """Write a summary in the format of the path's ending, with its note where the format has text.

    LaTeX is a `tabular` and a line of small print, for your own float; it needs `booktabs`.
    One wider than its `size` (of `WIDTHS_PT`, `text` by default) becomes several.
    """
    if path.suffix in (".csv", ".parquet"):
        write_frame(found, path)
        return
    frame = shown(found)
    if path.suffix == ".tex":
        small = (
            f"\\par\\smallskip\\noindent\\parbox{{\\linewidth}}{{\\footnotesize {latex(note)}}}\n"
        )
        table = to_latex(frame, DIGITS, WIDTHS_PT[size or "text"])
        engine = "" if table.isascii() else ", and LuaLaTeX if pdfLaTeX lacks a letter"
        text = f"% needs \\usepackage{{booktabs}}{engine}\n{table}{small}"
    elif path.suffix == ".md":
        text = f"{escape_markdown(note)}\n\n{to_markdown(frame, DIGITS)}"
    else:
        cells = written(frame, HTML, DIGITS)
        text = render(
            "table.html",
            name=name,
            note=note,
            head=[Markup(head) for head in cells],
            numeric=numeric_columns(frame),
            rows=[[Markup(cell) for cell in row] for row in cells.to_numpy()],
        )
    write_text(path, text)


def statuses(table: pd.DataFrame) -> list[tuple[str, int]]:
    """How the runs ended, in words, with how often; numbers in details count as the same."""
    detail = table["status_detail"].fillna("") if "status_detail" in table else ""
    words = table["status"].map(lambda status: WORDS[Outcome(status)])
    same = pd.Series(detail, table.index).str.replace(r"\d+(\.\d+)?", "...", regex=True)
    counts = (words + same.map(lambda text: f": {text}" if text else "")).value_counts()
    rest = counts[_MOST_REMARKS:].sum()
    found = list(counts[:_MOST_REMARKS].items())
    return [*found, ("ended in other ways", int(rest))] if rest else found


def write_rows(rows: pd.DataFrame, out: Path) -> str:
    """Write every row, with all its columns; say how many."""
    write_frame(rows, out)
    return f"{out}: {pluralize(len(rows), 'row')}, {len(rows.columns)} columns"


_NARROW = (ERROR, f"{ANSWER}nees_mean")


def table_of(
    rows: pd.DataFrame,
    name: str,
    out: Path | None,
    against: str | None,
    metrics: Sequence[str],
    size: str | None,
    *,
    efficiency: bool = False,
) -> str:
    """Mean errors of a sweep as lines, or in a file; then it says how many rows that has."""
    narrow = size == "column" and not metrics  # one table as wide as a column
    if narrow:  # with `against`, the ratio of the errors takes the place of the NEES
        metrics = [m for m in _NARROW[: 1 if against else 2] if m.removeprefix(ANSWER) in rows]
    found = summary(rows, against, metrics, efficiency=efficiency)
    found = found.assign(with_remarks=0) if narrow else found
    note = notes(found, against)
    if out is not None:
        write_table(found, note, out, Path(name).name, size)
        return f"{out}: {pluralize(len(found), 'row')}"
    lines = as_lines(found, note)
    if not metrics and (winner := find_winner(rows)):
        lines += "\n\n" + "\n".join(winner.sentences())
    if (rows["status"] != Outcome.OK).any():
        lines += "\n\n" + "\n".join(f"{count} {words}" for words, count in statuses(rows))
    return lines
