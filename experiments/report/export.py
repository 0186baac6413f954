"""Tables for papers and pages: LaTeX (booktabs) and Markdown."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.runs.columns import title
from experiments.runs.row import read_rows
from sim.errors import InputError, printable
from sim.files import write_whole

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        **{character: f"\\{character}" for character in "&%$#_{}"},
    }
)
_MARKDOWN = str.maketrans({character: f"\\{character}" for character in "\\|<[]!`"})


def read_table(path: Path) -> pd.DataFrame:
    """Read any table; texts stay as they are written, integers among gaps stay integers.

    Raises
    ------
    InputError
        If it is not there, or neither CSV nor Parquet.
    """
    try:
        frame = read_rows(path)
        as_csv = path.suffix == ".csv"
        written = (
            pd.read_csv(path, dtype="str", keep_default_na=False, index_col=False)
            if as_csv
            else frame
        )
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


def as_text(frame: pd.DataFrame, digits: int = 4) -> pd.DataFrame:
    """Every cell as `plain` writes it, under headings with units."""
    heads = [printable(" ".join(title(str(name)).split())) for name in frame]
    cells = frame.set_axis(heads, axis=1).astype(object)
    return cells.map(lambda value: printable(" ".join(plain(value, digits).split())))


def numeric(frame: pd.DataFrame) -> list[bool]:
    """Whether each column holds numbers."""
    return [dtype.kind in "iuf" for dtype in frame.dtypes]


def escaped(text: str) -> str:
    """Text in which Markdown and HTML find nothing of theirs."""
    return text.translate(_MARKDOWN)


def to_markdown(frame: pd.DataFrame, digits: int = 4) -> str:
    """Pipe table; columns of numbers are aligned to the right."""
    cells = as_text(frame, digits).map(escaped)
    table: str = cells.rename(columns=escaped).to_markdown(
        index=False,
        tablefmt="pipe",
        disable_numparse=True,
        colalign=["right" if number else "left" for number in numeric(frame)],
    )
    return table + "\n"


def to_latex(frame: pd.DataFrame, digits: int = 4) -> str:
    """A `tabular` that needs `booktabs`; numbers such as 1e-05 become powers of ten."""
    cells = as_text(frame, digits).map(_latex).rename(columns=_latex)
    columns = "".join("r" if number else "l" for number in numeric(frame))
    table: str = cells.style.hide(axis="index").to_latex(column_format=columns, hrules=True)
    return re.sub(r"(?m)^(?=[*\[])", "{}", table)  # else \\ takes it as its argument


def _latex(text: str) -> str:
    power = re.fullmatch(r"(-?[\d.]+)e([+-]\d+)", text)
    if power:
        return rf"${power[1]} \times 10^{{{int(power[2])}}}$"
    return f"${text}$" if re.fullmatch(r"-[\d.]+", text) else text.translate(_LATEX)


FORMATS: dict[str, tuple[Callable[[pd.DataFrame, int], str], str]] = {
    "markdown": (to_markdown, ".md"),
    "latex": (to_latex, ".tex"),
}


def export(paths: Sequence[Path], form: str, out: Path | None, digits: int) -> None:
    """Run `estima export-table`: print tables, or write them to the folder `out`.

    Raises
    ------
    InputError
        If a table cannot be read or shown, or two would become one file.
    """
    if form not in FORMATS:
        raise InputError(f"--format must be {' or '.join(FORMATS)}, got {form!r}")
    as_form, suffix = FORMATS[form]
    if out is None:
        for path in paths:
            text = as_form(read_table(path), digits)
            try:
                print(text)
            except UnicodeEncodeError as error:
                raise InputError(
                    f"{path}: the output's encoding, {error.encoding}, lacks "
                    f"{text[error.start]!a}; write files with -o, or set PYTHONIOENCODING=utf-8"
                ) from error
        return
    sources: dict[Path, Path] = {}
    for path in paths:
        target = out / f"{path.stem}{suffix}"
        if target in sources:
            raise InputError(f"{sources[target]} and {path} would both become {target}")
        sources[target] = path
    for target, path in sources.items():
        with write_whole(target) as part:
            part.write_text(as_form(read_table(path), digits), encoding="utf-8")
    print(f"{out}: {len(paths)} tables")
