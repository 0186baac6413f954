"""Exported tables match their files, and wrong input ends in one line."""

import io
import sys

import numpy as np
import pandas as pd
import pytest

from experiments.cli.tables import export_table
from experiments.report.export import export, read_table, to_latex, to_markdown
from experiments.runs.row import write_frame
from sim.errors import InputError


def test_cells_are_shown_as_they_are_written(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("n,name,x,none,ok\n123456,NA,1.23456,NA,True\n,None,NA,NA,\n7,,2,NA,False\n")
    assert to_markdown(read_table(path)).splitlines()[1:] == [
        "|-------:|:-------|------:|:-------|:-----|",
        "| 123456 | NA     | 1.235 | NA     | yes  |",
        "|        | None   |       | NA     |      |",
        "|      7 |        |     2 | NA     | no   |",
    ]
    pd.DataFrame({"n": pd.array([123456, None], "Int64"), "x": [1e20, None]}).to_parquet(
        tmp_path / "t.parquet"
    )
    rows = to_markdown(read_table(tmp_path / "t.parquet")).splitlines()[1:]
    assert rows == ["|-------:|------:|", "| 123456 | 1e+20 |", "|        |       |"]


def test_metrics_are_named_with_their_unit():
    frame = pd.DataFrame({"ate_rmse_m": [0.5], "revised_nees_mean": [3.0], "k_m": [1e-5]})
    assert to_markdown(frame).splitlines()[0] == (
        "|   position RMSE, m |   mean NEES (3 when consistent), revised path |   k, m |"
    )


def test_brackets_are_no_arguments_of_the_row_before():
    lines = to_latex(pd.DataFrame({"[m]": ["[1, 2]", "*", "a[1]"], "b": ["[", "*", "c"]}))
    assert lines.splitlines()[2:7] == [
        r"{}[m] & b \\",
        r"\midrule",
        r"{}[1, 2] & [ \\",
        r"{}* & * \\",
        r"a[1] & c \\",
    ]


def test_two_tables_never_become_one_file(tmp_path):
    paths = [tmp_path / "a" / "t.csv", tmp_path / "b" / "t.csv"]
    for path in paths:
        path.parent.mkdir()
        path.write_text("x\n1\n")
    with pytest.raises(InputError, match=r"a/t\.csv and .*b/t\.csv would both become .*t\.md"):
        list(export(paths, "markdown", tmp_path / "out", 4))
    assert not (tmp_path / "out").exists()
    list(export(paths, "markdown", None, 4))  # on paper both have their place


def test_letters_that_the_output_lacks_are_named(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    path.write_text("name\n\u00e9\n", encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    with pytest.raises(InputError, match=r"ascii, lacks '\\xe9' .*; write files, or set"):
        export_table([path], digits=4)
    list(export([path], "markdown", tmp_path, 4))
    assert "\u00e9" in (tmp_path / "t.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["README.md", "damaged.csv", "missing.csv"])
def test_a_file_that_is_no_table_is_refused_without_advice_to_delete_it(tmp_path, name):
    (tmp_path / "README.md").write_text("# Read me\n")
    (tmp_path / "damaged.csv").write_text('a,b\n1,2\n3,4,5,6\n"')
    with pytest.raises(InputError, match=f"{name}.*needs a CSV or Parquet table") as refusal:
        list(export([tmp_path / name], "markdown", None, 4))
    assert "delete" not in str(refusal.value)
    assert "\n" not in str(refusal.value)


TABLE = pd.DataFrame(
    {"case_name": ["a|b", "50 % & {x}\\"], "k_m": [1e-5, np.nan], "n": [3, 4], "ok": [True, False]}
)


def test_markdown():
    assert to_markdown(TABLE).splitlines() == [
        r"| case name     |   k, m |   n | ok   |",
        r"|:--------------|-------:|----:|:-----|",
        r"| a\|b          |  1e-05 |   3 | yes  |",
        r"| 50 % \& {x}\\ |        |   4 | no   |",
    ]


def test_latex():
    lines = to_latex(TABLE).splitlines()
    assert lines[0] == r"\begin{tabular}{lrrl}"
    assert lines[2] == r"case name & k, m & n & ok \\"
    assert lines[4] == r"a\textbar{}b & $1 \times 10^{-5}$ & 3 & yes \\"
    assert lines[5] == r"50 \% \& \{x\}\textbackslash{} &  & 4 & no \\"
    assert "$-1.5$" in to_latex(pd.DataFrame({"x": [-1.5]}))
    assert lines[-1] == r"\end{tabular}"


def test_export_from_the_command_line(tmp_path):
    from typer.testing import CliRunner

    from experiments.cli.main import app

    write_frame(TABLE[["n"]], tmp_path / "t.csv")
    done = CliRunner().invoke(app, ["export-table", str(tmp_path / "t.csv")])
    assert done.stdout == "|   n |\n|----:|\n|   3 |\n|   4 |\n\n"
    out = tmp_path / "exported"
    CliRunner().invoke(
        app, ["export-table", str(tmp_path / "t.csv"), "--format", "latex", "-o", str(out)]
    )
    assert (out / "t.tex").read_text().startswith(r"\begin{tabular}{r}")
    wrong = CliRunner().invoke(app, ["export-table", str(tmp_path / "t.csv"), "--format", "x"])
    assert "the format must be markdown or latex" in str(wrong.exception)
