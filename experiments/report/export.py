"""Tables for papers and pages: LaTeX (booktabs) and Markdown."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from experiments.runs.columns import format_alike, is_setting, title
from experiments.runs.row import read_rows
from experiments.sweeps.summary import MARKS, SUFFIXES
from sim.errors import InputError, printable, require
from sim.files import write_text

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        "`": r"\textasciigrave{}",
        '"': r"\textquotedbl{}",
        "µ": r"$\mu$",
        "²": r"$^{2}$",
        **{character: f"\\{character}" for character in "&%$#_{}"},
    }
)
_MARKDOWN = re.compile(r"[\\|<\[\]!`*~&$]|(?<![^\W_])_|_(?![^\W_])")
TEXT_PT = 345.0  # width of the text of LaTeX's article
_LETTER_PT, _SMALL_LETTER_PT = 5.0, 4.4  # width of a letter, of \footnotesize
_GAP_PT, _SMALL_GAP_PT = 12.0, 6.0  # between columns
_TEXT_LETTERS, _HEAD_LETTERS = 24, 12  # of a line in a cell, in a heading, of a wide table


def read_table(path: Path) -> pd.DataFrame:
    """Read any table; texts stay as they are written, integers among gaps stay integers.

    Raises
    ------
    InputError
        If it is not there, or neither CSV nor Parquet.
    """
    try:
        frame = read_rows(path)
        written = frame
        if path.suffix == ".csv":
            written = pd.read_csv(path, dtype="str", keep_default_na=False, index_col=False)
    except (InputError, ValueError, OverflowError) as error:
        why = [*str(error.__cause__ or "no table there").splitlines(), "unreadable"][0].rstrip(".")
        raise InputError(f"{path}: {why}; export-table needs a CSV or Parquet table") from error
    for name, column in list(frame.items()):
        filled = column.dropna()
        if filled.empty or isinstance(column.dtype, pd.StringDtype):
            frame[name] = written[name]  # "NA" is a gap among numbers, but a text among texts
        elif (
            column.dtype.kind == "f"
            and column.hasnans
            and ((filled % 1.0 == 0.0) & (filled.abs() < 2.0**53)).all()
        ):
            frame[name] = column.astype("Int64")
    return frame


def plain(value: Any, digits: int = 4) -> str:
    """A cell as text: floats with so many significant digits, nothing where it is empty."""
    if pd.isna(value):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def setting_texts(column: pd.Series[Any], digits: int = 4) -> list[str]:
    """The values of a setting as `plain` texts, its numbers all in one way."""
    if column.dtype.kind != "f":
        return [plain(value) for value in column]
    texts = format_alike(column, digits)
    return ["" if text == "nan" else text for text in texts]


def significant(value: float, digits: int) -> str:
    """A number with so many significant digits; zeros at its end are some of them."""
    if not 0.0 < abs(value) < 1e6:
        return plain(value, digits)
    rounded = float(f"{value:.{digits - 1}e}")
    return f"{rounded:.0f}" if abs(rounded) >= 10 ** (digits - 1) else f"{rounded:#.{digits}g}"


class Mean(NamedTuple):
    """A cell: a mean with the bounds of its interval, and how it is marked."""

    value: float
    low: float
    high: float
    best: bool
    differs: bool


def fold_intervals(frame: pd.DataFrame) -> pd.DataFrame:
    """Put a mean, its bounds and its marks, columns of `sweeps.summary`, into one cell."""
    cells = {}
    for name in frame:
        parts = [f"{name}{suffix}" for suffix in SUFFIXES]
        if set(parts) <= set(frame):
            marks = [frame.get(f"{name}_{mark}", [False] * len(frame)) for mark in MARKS]
            columns = zip(frame[name], *(frame[part] for part in parts), *marks, strict=True)
            cells[name] = pd.Series([Mean(*cell) for cell in columns], frame.index, object)
    gone = {f"{name}{end}" for name in cells for end in (*SUFFIXES, *(f"_{m}" for m in MARKS))}
    return frame.assign(**cells).drop(columns=[name for name in frame if name in gone])


class Form(NamedTuple):
    """How a kind of file writes text, the best mean, one that differs, and an interval."""

    escape: Callable[[str], str]
    best: str
    differs: str
    interval: str = " [{}, {}]"


def written(frame: pd.DataFrame, form: Form, digits: int) -> pd.DataFrame:
    """Every cell as text, under headings with units."""

    def text(value: Any) -> str:
        if not isinstance(value, Mean):
            return form.escape(printable(" ".join(plain(value, digits).split())))
        number, low, high = (form.escape(significant(part, digits)) for part in value[:3])
        if value.best:
            number = form.best.format(number)
        bounds = form.interval.format(low, high) if low and value.low < value.high else ""
        return number + (form.differs if value.differs else "") + bounds

    long = not any(isinstance(cell, Mean) for cell in frame.head(1).to_numpy().ravel())
    heads = [" ".join(title(str(name), short=not long).split()) for name in frame]
    numbers = [c for c in frame if is_setting(str(c)) and frame[c].dtype.kind == "f"]
    alike_in = {name: setting_texts(frame[name], digits) for name in numbers}
    return (
        frame.assign(**alike_in)
        .set_axis([form.escape(printable(h)) for h in heads], axis=1)
        .astype(object)
        .map(text)
    )


def as_text(frame: pd.DataFrame, digits: int = 4) -> pd.DataFrame:
    """Every cell as `plain` writes it, under headings with units."""
    return written(frame, Form(str, "{}", "*"), digits)


def numeric_columns(frame: pd.DataFrame) -> list[bool]:
    """Whether each column holds numbers."""
    return [
        column.dtype.kind in "iuf" or column.map(lambda cell: isinstance(cell, Mean)).any()
        for _, column in frame.items()
    ]


def escape_markdown(text: str) -> str:
    """Text in which Markdown and HTML find nothing of theirs."""
    return _MARKDOWN.sub(r"\\\g<0>", text)


def to_markdown(frame: pd.DataFrame, digits: int = 4) -> str:
    """Pipe table; columns of numbers are aligned to the right."""
    table: str = written(frame, Form(escape_markdown, "**{}**", r"\*"), digits).to_markdown(
        index=False,
        tablefmt="pipe",
        disable_numparse=True,
        colalign=["right" if number else "left" for number in numeric_columns(frame)],
    )
    return table + "\n"


def to_latex(frame: pd.DataFrame, digits: int = 4, width_pt: float = TEXT_PT) -> str:
    """A `tabular` that needs `booktabs`; numbers such as 1e-05 become powers of ten.

    What is wider than `width_pt` becomes small, with intervals below their means and long texts in
    lines; if that does not do, several tabulars, each with the columns that tell the rows apart.
    """
    best, differs = r"\textbf{{\boldmath {}}}", "$^{*}$"
    cells = written(frame, Form(latex, best, differs), digits)
    columns = "".join("r" if number else "l" for number in numeric_columns(frame))
    if sum(_widths(cells, _LETTER_PT, _GAP_PT)) <= width_pt:
        return _tabular(cells, columns)
    small = Form(lambda text: _in_lines(text, _TEXT_LETTERS), best, differs, "\n[{}, {}]")
    narrow = small._replace(escape=lambda text: _in_lines(text, _HEAD_LETTERS))
    heads = written(frame, narrow, digits).columns
    cells = written(frame, small, digits).set_axis(heads, axis=1)
    widths, n_keys = _widths(cells, _SMALL_LETTER_PT, _SMALL_GAP_PT), _n_keys(frame)
    parts = [[*range(n_keys)]]
    for column in range(n_keys, len(widths)):
        if len(parts[-1]) > n_keys and sum(widths[i] for i in [*parts[-1], column]) > width_pt:
            parts.append([*range(n_keys)])
        parts[-1].append(column)
    tabulars = [_tabular(cells.iloc[:, part], "".join(columns[i] for i in part)) for part in parts]
    small_print = r"{\footnotesize\setlength{\tabcolsep}{3pt}"
    return f"{small_print}\n" + "\\par\\medskip\\noindent\n".join(tabulars) + "\\par}\n"


def _in_lines(text: str, most: int) -> str:
    return "\n".join(map(latex, textwrap.wrap(text, most)))


def _widths(cells: pd.DataFrame, letter_pt: float, gap_pt: float) -> list[float]:
    """About how wide the columns will be, points."""

    def letters(text: str) -> int:
        seen = re.sub(r"\\[a-z]+\{\}", "x", text)  # what remains of commands is not seen
        return max(len(re.sub(r"\\[a-z]+|[\\{}$]", "", line)) for line in seen.split("\n"))

    return [
        gap_pt + letter_pt * max(map(letters, [str(head), *cells.iloc[:, i]]))
        for i, head in enumerate(cells)
    ]


def _n_keys(frame: pd.DataFrame) -> int:
    """How many of the first columns tell the rows apart; one if none do."""
    counts = range(1, frame.shape[1])
    return next((n for n in counts if not frame.iloc[:, :n].duplicated().any()), 1)


def _tabular(cells: pd.DataFrame, columns: str) -> str:
    """Cells of one or several lines as the rows of a `tabular`; headings stand at the bottom."""
    heads = [str(head).split("\n") for head in cells]
    most = max(map(len, heads))
    rows = [[cell.split("\n") for cell in row] for row in cells.to_numpy().tolist()]
    apart = any(len(cell) > 1 for row in rows for cell in row)
    frame = pd.DataFrame(
        [_row(row, "\\addlinespace\n" if i and apart else "") for i, row in enumerate(rows)],
        columns=_row([[*[""] * (most - len(head)), *head] for head in heads]),
    )
    with pd.option_context(
        "styler.render.max_elements", frame.size + 1
    ):  # else rows may be left out
        tabular: str = frame.style.hide(axis=0).to_latex(column_format=columns, hrules=True)
    return tabular


def _row(cells: list[list[str]], before: str = "") -> list[str]:
    """The last lines of cells, with all that is above them in the first.

    A line that begins with * or [ would be an argument of the row before.
    """
    lines = [[*line] for line in zip_longest(*cells, fillvalue="")]
    for line in lines:
        line[0] = "{}" * line[0].startswith(("*", "[")) + line[0]
    above = [" & ".join(line) + " \\\\\n" for line in lines[:-1]]
    return [before + "".join(above) + lines[-1][0], *lines[-1][1:]]


def latex(text: str) -> str:
    """Text in which LaTeX finds nothing of its own; numbers become mathematics."""
    power = re.fullmatch(r"(-?[\d.]+)e([+-]?\d+)", text)
    if power:
        return rf"${power[1]} \times 10^{{{int(power[2])}}}$"
    if re.fullmatch(r"-[\d.]+", text):
        return f"${text}$"
    return re.sub("-(?=-)", "-{}", text.translate(_LATEX))  # else -- becomes a dash


FORMATS: dict[str, tuple[Callable[[pd.DataFrame, int], str], str]] = {
    "markdown": (to_markdown, ".md"),
    "latex": (to_latex, ".tex"),
}


def export(paths: Sequence[Path], form: str, out: Path | None, digits: int) -> Iterator[str]:
    """Tables as text; or, once they are written to the folder `out`, how many they are.

    Raises
    ------
    InputError
        If a table cannot be read or shown, or two would become one file.
    """
    require(form in FORMATS, f"the format must be {' or '.join(FORMATS)}, got {form!r}")
    as_form, suffix = FORMATS[form]
    names = [path.stem for path in paths] if out else []
    for i, path in enumerate(paths[: len(names)]):
        first = names.index(path.stem)
        require(
            first == i, f"{paths[first]} and {path} would both become {out}/{path.stem}{suffix}"
        )
    for path in paths:
        text = as_form(fold_intervals(read_table(path)), digits)
        if out is not None:
            write_text(out / f"{path.stem}{suffix}", text)
        else:
            yield text
    if out is not None:
        yield f"{out}: {len(paths)} tables"
