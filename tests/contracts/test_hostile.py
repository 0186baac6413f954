"""What a file must not do, in small: the whole of it is `tests/fixtures/attack.py`."""

import io
import json
import os
import platform
import zipfile
import zlib

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from experiments.report.export import as_text, to_markdown
from experiments.runs import store
from experiments.runs.console import exit_with, show
from experiments.runs.dependencies.sources import _known
from experiments.runs.row import read_parquet
from experiments.sweeps.launch import _drop, prepare
from sim.errors import InputError, printable
from sim.formats.detect import read_any
from sim.npz import read_arrays
from sim.recording import load
from sim.yaml_file import read_yaml
from tests.experiments.runs.test_store import row
from tests.fixtures.attack import attack_all
from tests.fixtures.attacks.base import Attack
from tests.fixtures.attacks.settings import BOMB

EVIL = "a\x1b[31m\r\nb\u202e<i>"


@pytest.mark.parametrize("kind", ["recordings", "estimates"])
def test_the_attacks_that_are_fast(kind):
    found = attack_all(only=[kind])
    assert not found.failures, "\n".join(found.failures)


def test_an_attack_that_comes_through_is_a_failure():
    found = Attack()
    found("x", "wrong", lambda: 2, right=1)
    found("x", "read", lambda: 1, refuse=True)
    found("x", "trace", lambda: 1 / 0)
    found("x", "printed", lambda: print("\x1b[31m"))
    found("x", "right", lambda: 1, right=1)
    assert [line.split(" (")[0] for line in found.failures] == [
        "x, wrong", "x, read", "x, trace", "x, printed",
    ]  # fmt: skip
    assert found.counts == {("x", "FAILED"): 4, ("x", "right"): 1}


def test_messages_are_one_printable_line_that_keeps_its_remedy(capsys):
    error = InputError(f"{EVIL}{'x' * 5000}; delete it")
    assert printable(str(error)) == str(error)
    assert len(str(error)) < 2100
    assert str(error).endswith("; delete it")
    with pytest.raises(SystemExit):
        exit_with(error)
    show(f"one\n{EVIL}\tthree")
    out, err = capsys.readouterr()
    assert err.count("\n") == 1
    assert out == "one\na?[31m?\nb?<i>?three\n"


def test_cells_cannot_become_markup():
    frame = pd.DataFrame({"a<b": [EVIL]})
    assert as_text(frame).iloc[0, 0] == "a?[31m b?<i>"
    assert r"b?\<i>" in to_markdown(frame)
    assert r"a\<b" in to_markdown(frame)
    links = to_markdown(pd.DataFrame({"a": ["[x](javascript:y)", "![](http://t/x.png)", "`b`"]}))
    for text in (r"\[x\](javascript:y)", r"\!\[\](http://t/x.png)", r"\`b\`"):
        assert text in links


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\nb: {c: 1, c: 2}\n", r"x\.yaml:2: the key c is there twice"),
        ("a: " + "[" * 5000 + "]" * 5000, r"nested more than 50 deep"),
        ("a: &a [*a]\n", r"nested more than 50 deep"),
        (BOMB, r"aliases \(\*\) stand for more than 1000000 values"),
        ("a: " + "9" * 5000, r"not valid YAML"),
        ("a: !!bool x", r"not valid YAML"),
        ('a: 1\nb: ["x\\0y"]', r"x\.yaml:2: holds a zero byte"),
        ('a: {"x\\ud800": 1}', r"x\.yaml:1: holds a zero byte or half a character"),
    ],
    ids=["twice", "deep", "endless", "bomb", "long number", "bad tag", "zero", "half"],
)
def test_yaml_out_of_bounds(tmp_path, text, words):
    path = tmp_path / "x.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_yaml(path)


def test_yaml_within_bounds(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("a: &a {k: [1, 2]}\nb: *a\nc: {<<: *a, m: 3}\n")
    same = {"k": [1, 2]}
    assert read_yaml(path) == {"a": same, "b": same, "c": {"m": 3, **same}}
    path.write_text("")
    assert read_yaml(path) is None


def test_arrays_promise_no_more_than_the_file_holds(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.arange(6.0).reshape(2, 3), b=np.zeros((0, 4), np.uint8))
    found = read_arrays(path)
    assert found["a"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert (found["b"].shape, found["b"].dtype) == ((0, 4), np.uint8)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", header.getvalue())
    with pytest.raises(InputError, match=r"an array of shape \(1000000000000,\)"):
        read_arrays(path)


@pytest.mark.parametrize("name", ["x.npz", "x.log", "x.yaml"])
def test_a_pipe_is_refused_at_once(tmp_path, name):
    os.mkfifo(tmp_path / name)
    for read in (load, lambda path: read_any([path]), read_yaml):
        with pytest.raises(InputError, match=r"not a file|no such recording"):
            read(tmp_path / name)


@pytest.mark.parametrize("name", ["rows-q.journal", "plan-x.json"])
def test_a_pipe_among_the_rows_is_refused_at_once(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: not a file"):
        prepare(tmp_path)


@pytest.mark.parametrize("planner", ["1" + "0" * 23, "-" + "9" * 20, "1" * 5000, "[" * 5000])
def test_a_forged_plan_is_left_alone(tmp_path, planner):
    plan = tmp_path / "plan-y.json"
    plan.write_text(f'{{"planner": ["{platform.node()}", {planner}]}}')
    prepare(tmp_path)
    assert plan.exists()


def test_forged_lines_of_a_journal_are_passed_over():
    def line(text):
        return b"%08x %s\n" % (zlib.crc32(text), text)

    good = json.dumps([row(1)]).encode()
    forged = [b"b3", b'b"x"', b"={}", b"=[]", b"=[3]", b"=[{}]", b"=" + b"[" * 5000, b"+[{}]"]
    content = b"".join(map(line, [*forged, b"=" + good]))
    assert list(store.journal_lines(content)) == [(f"{1:016x}", [row(1)])]


def test_rows_that_cannot_be_read_now_are_kept(tmp_path):
    path = store.write_run([row(1)], tmp_path)
    unreadable = InputError("cannot read")
    unreadable.__cause__ = PermissionError(13, "Permission denied")
    with pytest.raises(InputError, match="cannot read"):
        _drop(path, unreadable)
    assert path.exists()
    _drop(path, InputError("it does not match its checksum"))
    assert not path.exists()


def test_a_column_that_is_there_twice_is_refused(tmp_path):
    table = pa.Table.from_arrays([pa.array([1]), pa.array([2])], names=["seed", "seed"])
    pq.write_table(table, tmp_path / "x.parquet")
    with pytest.raises(InputError, match=r"x\.parquet: .*seed is there twice"):
        read_parquet(tmp_path / "x.parquet")


def test_a_pipe_in_place_of_the_kept_sources(tmp_path):
    os.mkfifo(tmp_path / "sources.json")
    assert _known(tmp_path / "sources.json") == {}
