"""Exported tables match their files, and wrong input ends in one line."""

import io
import sys

import pandas as pd
import pytest

from experiments.report.export import export, read_table, to_latex, to_markdown
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
        export(paths, "markdown", tmp_path / "out", 4)
    assert not (tmp_path / "out").exists()
    export(paths, "markdown", None, 4)  # on paper both have their place


def test_letters_that_the_output_lacks_are_named(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    path.write_text("name\n\u00e9\n", encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    with pytest.raises(InputError, match=r"ascii, lacks '\\xe9'; write files with -o"):
        export([path], "markdown", None, 4)
    export([path], "markdown", tmp_path, 4)
    assert "\u00e9" in (tmp_path / "t.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["README.md", "damaged.csv", "missing.csv"])
def test_a_file_that_is_no_table_is_refused_without_advice_to_delete_it(tmp_path, name):
    (tmp_path / "README.md").write_text("# Read me\n")
    (tmp_path / "damaged.csv").write_text('a,b\n1,2\n3,4,5,6\n"')
    with pytest.raises(InputError, match=f"{name}.*needs a CSV or Parquet table") as refusal:
        export([tmp_path / name], "markdown", None, 4)
    assert "delete" not in str(refusal.value)
    assert "\n" not in str(refusal.value)
