"""Rows on disk: journals, Parquet files, and what damage does to them."""

import json
import os
import random

import numpy as np
import pandas as pd
import pytest

from experiments.runs import store
from experiments.runs.row import Outcome, Status
from experiments.runs.version import code_version
from sim.errors import InputError


def row(number, **values):
    """A row of the run with this number as its key."""
    origin = {
        "run_key": f"{number:016x}",
        "code_version": code_version(),
        "recording_checksum": "c",
    }
    return {"seed": number, "robot.kr": 1e-5, "repeat": 0, **origin, **Status().columns(), **values}


def filled(path, numbers=range(20)):
    """A journal of runs, whose rows have different columns now and then."""
    with store.journal(path) as journal:
        for number in numbers:
            journal.begin(f"{number:016x}")
            extra = {"rpe_1m_rmse_m": 0.5} if number % 5 == 0 else {}
            journal.append([row(number, ate_rmse_m=number / 7, **extra)])
    return path


def test_a_journal_says_what_was_written(tmp_path):
    path = tmp_path / "rows-a.journal"
    rows = [row(1, x=0.1), row(1, x=-0.0, repeat=1), row(1, x=True, repeat=2)]
    failed = row(2, **Status.of_error(ValueError("no")).columns())
    with store.journal(path) as journal:
        journal.append(rows)
        journal.append([row(3, x=0.0), row(3, x=0.1, repeat=1)])
        journal.append([failed])
        journal.begin(f"{4:016x}")
    found = [rows for _, rows in store.journal_lines(path.read_bytes())]
    expected = [rows, [row(3, x=0.0), row(3, x=0.1, repeat=1)], [failed], []]
    assert json.dumps(found) == json.dumps(expected)
    assert store.find_begun_runs(tmp_path, "rows-") == {4}
    over = store.ended(tmp_path)
    assert over.done.tolist() == [1, 3]
    assert over.failed == {2: "ValueError: no"}


def test_any_damage_of_a_journal_costs_rows_but_gives_no_wrong_ones(tmp_path):
    path = filled(tmp_path / "rows-a.journal")
    content, rng = path.read_bytes(), random.Random(0)
    sound = {key: rows for key, rows in store.journal_lines(content) if rows}
    assert len(sound) == 20
    for _ in range(300):
        damaged = bytearray(content)
        at = rng.randrange(len(damaged))
        kind = rng.randrange(3)
        if kind == 0:
            damaged[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del damaged[at:]
        else:
            del damaged[at : at + rng.randrange(1, 400)]
        for key, rows in store.journal_lines(bytes(damaged)):
            assert not rows or sound[key] == rows


def test_what_is_written_together_does_not_decide_the_table(tmp_path):
    one, many = tmp_path / "one", tmp_path / "many"
    store.compact(filled(one / "rows-a.journal"))
    for i, numbers in enumerate((range(12, 20), range(3), range(3, 12))):
        filled(many / f"rows-{i}.journal", numbers)
    store.compact(many / "rows-1.journal")
    left, right = (
        store.read_runs(folder).sort_values("seed", ignore_index=True) for folder in (one, many)
    )
    pd.testing.assert_frame_equal(left, right, check_exact=True)
    assert sorted(p.suffix for p in many.iterdir()) == [".journal"] * 2 + [".parquet"] * 2
    store.tidy(many, lambda name: name == "rows-0.journal")
    assert (many / "rows-0.journal").exists()
    store.tidy(many, lambda _: False)
    assert {p.suffix for p in many.iterdir()} == {".parquet"}
    pd.testing.assert_frame_equal(
        left, store.read_runs(many).sort_values("seed", ignore_index=True), check_exact=True
    )


def test_damaged_parquet_is_refused(tmp_path):
    store.compact(filled(tmp_path / "rows-a.journal"))
    first, second = sorted(tmp_path.iterdir())
    content = first.read_bytes()
    for damaged in (content[:-1], content[:50] + b"x" + content[51:], second.read_bytes(), b""):
        first.write_bytes(damaged)
        with pytest.raises(InputError, match=rf"{first.name}.*does not match its checksum"):
            store.read_runs(tmp_path)
        dropped = []
        store.ended(tmp_path, damaged=lambda path, _, dropped=dropped: dropped.append(path))
        assert dropped == [first]


def test_what_is_no_file_of_rows_is_refused(tmp_path):
    os.mkfifo(tmp_path / "x.parquet")
    with pytest.raises(InputError, match=r"x\.parquet: not a file of rows; remove it"):
        store.ended(tmp_path)
    (tmp_path / "x.parquet").unlink()
    (tmp_path / "x.journal").mkdir()
    with pytest.raises(InputError, match=r"x\.journal: not a file of rows; remove it"):
        store.read_runs(tmp_path)


def test_a_run_that_did_not_fail_is_kept_else_the_last(tmp_path):
    bad = Status(Outcome.FAILED, "died", "first").columns()
    worse = Status(Outcome.FAILED, "died", "second").columns()
    for name, rows in (
        ("rows-0", [row(1, **bad), row(2), row(3, **bad)]),
        ("rows-1", [row(1), row(2, **bad), row(3, **worse)]),
    ):
        with store.journal(tmp_path / f"{name}.journal") as journal:
            for each in rows:
                journal.append([each])
    table = store.read_runs(tmp_path).set_index("seed")["status_detail"].to_dict()
    assert table == {1: "", 2: "", 3: "second"}
    over = store.ended(tmp_path)
    assert over.done.tolist() == [1, 2]
    assert over.failed == {3: "died: second"}


def test_half_a_character_costs_nothing(tmp_path):
    """A program, a file's name or an exception may hold one; UTF-8 cannot."""
    status = Status.of_error(ValueError("\ud800 bad\nthing")).columns()
    assert status["status_detail"] == "? bad thing"
    with store.journal(tmp_path / "rows-a.journal") as journal:
        journal.append([row(1, **status)])
        journal.append([row(2, **{"status_detail": "\udfff", "a\ud800": "b\ud800"})])
    assert store.ended(tmp_path).failed == {1: "ValueError: ? bad thing"}
    store.compact(tmp_path / "rows-a.journal")
    table = store.read_runs(tmp_path).set_index("seed")
    assert table.loc[2, "status_detail"] == "?"
    assert table.loc[2, "a?"] == "b?"
    store.write_run([row(3, x="\ud800")], tmp_path)


class UnreadableError(Exception):
    def __str__(self):
        raise RuntimeError


def test_an_exception_without_words_is_a_status():
    assert Status.of_error(UnreadableError()).detail == "its message cannot be read"


WRONG = {
    "run_key": ["../../x", "", None, "a b", "x" * 65],
    "status": ["odd", "", None, "OK"],
    "repeat": [None, float("nan"), 0.5],
}


@pytest.mark.parametrize(("column", "value"), [(c, v) for c in WRONG for v in WRONG[c]])
def test_a_row_that_is_none_is_refused_wherever_it_is_read_or_written(tmp_path, column, value):
    bad = {**row(1), column: value}
    pd.DataFrame([bad, row(2)]).to_parquet(tmp_path / "rows-a.parquet")
    for read in (store.read_runs, store.ended)[: 1 + (column != "repeat")]:
        with pytest.raises(InputError, match=rf"column {column} holds \[.*; delete the file"):
            read(tmp_path)
    pd.DataFrame([bad, row(2)]).to_csv(tmp_path / "rows.csv", index=False)
    with pytest.raises(InputError, match=rf"column {column} holds"):
        store.read_runs(tmp_path / "rows.csv")
    with pytest.raises(InputError, match=column):
        store.write_run([bad], tmp_path / "out")
    with store.journal(tmp_path / "rows-b.journal") as journal:
        journal.append([bad])
    assert not list(store.journal_lines((tmp_path / "rows-b.journal").read_bytes()))


@pytest.mark.parametrize("value", [-1.0, 1e300, np.inf, "much"])
def test_an_error_that_no_run_can_have_is_refused(tmp_path, value):
    rows = pd.DataFrame([row(1, ate_rmse_m=value), row(2, ate_rmse_m=value)])
    rows.to_parquet(tmp_path / "rows-a.parquet")
    with pytest.raises(InputError, match=r"column ate_rmse_m holds \[.* in run 0*1;"):
        store.read_runs(tmp_path)
    rows.assign(ate_rmse_m=[None, 0.1]).to_parquet(tmp_path / "rows-a.parquet")
    assert store.read_runs(tmp_path)["ate_rmse_m"].sum() == 0.1


def test_a_single_run_replaces_its_rows(tmp_path):
    for value in (1.0, 2.0):
        path = store.write_run([row(7, x=value)], tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert store.read_runs(tmp_path)["x"].tolist() == [2.0]


def test_many_small_files_become_few(tmp_path):
    for number in range(120):
        store.write_run([row(number, x=float(number))], tmp_path)
    store.tidy(tmp_path, lambda _: False)
    assert len(list(tmp_path.iterdir())) == 1
    table = store.read_runs(tmp_path)
    assert sorted(table["seed"]) == list(range(120))
    assert np.array_equal(table["x"], table["seed"])


def test_a_full_disk_leaves_whole_lines(tmp_path):
    os.symlink("/dev/full", tmp_path / "rows-a.journal")
    with (
        store.journal(tmp_path / "rows-a.journal") as journal,
        pytest.raises(InputError, match=r"cannot write \(No space left.*free some space"),
    ):
        journal.begin("0")
