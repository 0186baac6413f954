"""A study that was interrupted goes on with the jobs that it had finished, to the same bytes."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.judging.jobs import tables_of
from experiments.judging.kept_jobs import file_of, keep, kept
from experiments.judging.results import Profile
from experiments.runs.dependencies.recorder import recorded
from experiments.runs.experiment import Experiment


def job(number, ran, fails_at=None):
    """A row and a frame; it leaves a file for each time that it ran."""
    with (Path(ran) / f"{number}").open("a") as file:
        file.write("x")
    if number == fails_at:
        raise ValueError("stop")
    value = np.float32(0.1) * number
    frame = pd.DataFrame({"n": np.array([number], np.int32), "x": [None], "y": [np.nan]})
    return {"rows": [{"n": np.int64(number), "value": value, "ok": np.True_}], "frames": frame}


def judge(keep_in, ran, fails_at=None):
    jobs = [(number, str(ran), fails_at) for number in range(4)]
    with recorded(__name__) as seen:
        seen.keep_in = keep_in
        return tables_of(job, jobs)


def times_run(ran):
    return {path.name: len(path.read_text()) for path in ran.iterdir()}


def as_csv(tables):
    return {name: frame.to_csv() for name, frame in tables.items()}


def test_finished_jobs_are_not_run_again(tmp_path):
    (ran := tmp_path / "ran").mkdir()
    whole = as_csv(judge(tmp_path / "kept", ran))
    first = next((tmp_path / "kept").glob("*.job"))
    first.unlink()
    assert as_csv(judge(tmp_path / "kept", ran)) == whole
    assert sorted(times_run(ran).values()) == [1, 1, 1, 2]


def test_a_damaged_file_counts_as_none(tmp_path):
    (ran := tmp_path / "ran").mkdir()
    whole = as_csv(judge(tmp_path / "kept", ran))
    for path in (tmp_path / "kept").glob("*.job"):
        path.write_text(path.read_text()[:-20])
    assert as_csv(judge(tmp_path / "kept", ran)) == whole
    assert set(times_run(ran).values()) == {2}


def test_what_depends_on_a_changed_file_is_run_again(tmp_path):
    path = file_of(tmp_path, job, [1])
    keep(path, {"rows": [{"n": 1}]}, {"sim/se2.py": "another"}, 1.0)
    assert path.exists()
    assert kept(path) is None


def test_nothing_is_kept_unless_asked(tmp_path):
    (ran := tmp_path / "ran").mkdir()
    judge(None, ran)
    judge(None, ran)
    assert set(times_run(ran).values()) == {2}


def test_names_differ_by_each_argument(tmp_path):
    one = Experiment.compose(["seed=1"])
    arguments = [
        [1], [2], ["1"], [None], [Profile.FULL], [Profile.QUICK], [(1, 2)], [{"a": 1}], [{"a": 2}],
        [range(3)], [one], [Experiment.compose(["seed=2"])], [Path("a")], [np.int64(3)],
    ]  # fmt: skip
    assert len({file_of(tmp_path, job, each) for each in arguments}) == len(arguments)
    assert file_of(tmp_path, job, [one]) == file_of(tmp_path, job, [Experiment.compose(["seed=1"])])
    assert file_of(tmp_path, judge, [1]) != file_of(tmp_path, job, [1])


@pytest.mark.parametrize("value", [object(), lambda: 1, np.zeros(3)])
def test_what_has_no_lasting_name_is_not_kept(value, tmp_path):
    assert file_of(tmp_path, job, [value]) is None


def test_tables_that_json_cannot_hold_are_not_kept(tmp_path):
    path = tmp_path / "a.job"
    keep(path, {"rows": [{"a": np.zeros(2)}]}, {}, 1.0)
    assert not path.exists()


def test_numbers_to_the_digit(tmp_path):
    path = tmp_path / "a.job"
    values = [0.1 + 0.2, np.pi * 1e-300, np.nan, np.inf, None, True, "a"]
    keep(path, {"rows": [{"v": v} for v in values]}, {}, 1.0)
    found = [row["v"] for row in kept(path)[0]["rows"]]
    assert json.dumps(found) == json.dumps(values)
