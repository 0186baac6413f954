"""Submissions: read from their folder, built, checked and scored alone."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.gate import submit
from experiments.gate.conform import CheckResult
from experiments.gate.submit import (
    check_submission,
    failures,
    read_submission,
    summary,
    table_of,
)
from sim.errors import InputError

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "external_odometry.py"
SAID = """
name: mine
license: MIT
address: https://example.org/mine
estimator:
  _target_: estimators.programs.external.External
  command: [python3, filter.py]
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path / "results"))
    made = tmp_path / "mine"
    made.mkdir()
    shutil.copy(EXAMPLE, made / "filter.py")
    (made / "submission.yaml").write_text(SAID)
    return made


@pytest.fixture
def quick(monkeypatch):
    """Drives of a metre in one class, and a single check."""
    compose = submit.Experiment.compose
    short = ["route.distance_m=1", "sensors.laser.n_beams=21"]
    monkeypatch.setattr(submit, "CLASSES", ("rooms",))
    monkeypatch.setattr(
        submit.Experiment, "compose", classmethod(lambda _, given: compose([*given, *short]))
    )
    monkeypatch.setattr(submit, "check_estimator", lambda *_, **__: [CheckResult("one", True, "")])


def test_a_program_is_scored_as_dead_reckoning_is(folder, quick):
    score, out = check_submission(folder, drives=2, seed=77)
    assert score.passed
    rows = pd.read_csv(out / "rows.csv")
    assert sorted(rows["seed"].unique()) == [77, 78]
    errors = rows.pivot_table(index="seed", columns="choice.estimator", values="ate_rmse_m")
    assert errors["mine"].to_numpy() == pytest.approx(errors["odometry"].to_numpy(), rel=1e-3)
    said = json.loads((out / "submission.json").read_text())
    assert said["first_seed"] == 77
    assert set(said["files"]) == {"filter.py", "submission.yaml"}
    assert "ok" in summary(score)
    assert table_of(score)["error over odometry's"].item() == pytest.approx(1.0, rel=1e-3)
    again, _ = check_submission(folder, folder.parent / "again", drives=2, seed=77)
    assert again.rows["ate_rmse_m"].tolist() == score.rows["ate_rmse_m"].tolist()


def test_seeds_are_drawn(folder, quick):
    drawn = [check_submission(folder, drives=1)[0].rows["seed"].iloc[0] for _ in range(2)]
    assert drawn[0] != drawn[1]
    assert min(drawn) >= 10_000


def test_a_class_runs_in_a_process_of_its_own(folder, quick):
    (folder / "theirs.py").write_text(
        "import os, pathlib\n"
        "from estimators.odometry import Odometry\n"
        f"pathlib.Path({str(folder / 'pid')!r}).write_text(str(os.getpid()))\n"
        "class Theirs(Odometry):\n    pass\n"
    )
    (folder / "submission.yaml").write_text(
        SAID.split("estimator:")[0] + "estimator: {_target_: theirs.Theirs, kr: 1e-4, kl: 1.0e-4}"
    )
    with pytest.raises(InputError, match="kr must be"):  # 1e-4 is a text to YAML 1.1
        check_submission(folder, drives=1, seed=5)
    text = (folder / "submission.yaml").read_text()
    (folder / "submission.yaml").write_text(text.replace("1e-4", "1.0e-4"))
    score, _ = check_submission(folder, drives=1, seed=5)
    assert score.passed, score.rows["status_detail"].tolist()
    import os

    assert (folder / "pid").read_text() != str(os.getpid())


def test_a_program_that_dies_fails_and_is_named(folder, quick):
    (folder / "filter.py").write_text("raise SystemExit('out of luck')\n")
    score, _ = check_submission(folder, drives=1, seed=5)
    assert not score.passed
    assert score.n_lost == 1
    assert "1 drive failed" in summary(score)
    assert "out of luck" in str(score.rows["status_detail"].iloc[0])
    assert table_of(score)["error over odometry's"].isna().all()


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("name: mine", "name: mine too", "name must be one word"),
        ("name: mine", "name: ekf_icp", "ekf_icp is a method of ours"),
        ("license: MIT", "", "license is missing"),
        ("license: MIT", "licence: MIT", "known: submission.license"),
        ("[python3, filter.py]", "python3 filter.py", "command must be a list"),
        ("[python3, filter.py]", "[no_such_program]", "no program no_such_program"),
        ("_target_: estimators.programs.external.External", "", "_target_ is missing"),
        ("license: MIT", "license: MIT\nbuild: ['false']", "its build failed"),
        ("license: MIT", "license: MIT\nbuild: [no_such_compiler]", "build cannot be run"),
        ("name: mine", "name: [", "not valid YAML"),
        ("license: MIT", "license: as you like", "license must be an SPDX identifier"),
        ("https://example.org/mine", "javascript:alert(1)", "address must be an address"),
        ("filter.py]", "filter.py, 500]", 'got 500: write it in quotes, "500"'),
        ("filter.py]", "'--kr=${robot.kr}']", "is not resolved in a submission"),
        ("[python3, filter.py]", "[filter.py]", "filter.py is not executable; chmod"),
        ("filter.py]", "filter.py]\n  step_s: 11.0", "step_s is at most 10 s"),
        ("license: MIT", "license: MIT\nbuild: [sh, -c, 'echo oh; exit 3']", "code 3: oh"),
    ],
)
def test_what_is_wrong_is_named(folder, quick, before, after, said):
    (folder / "submission.yaml").write_text(SAID.replace(before, after))
    with pytest.raises(InputError, match=said) as caught:
        check_submission(folder, drives=1)
    assert "\n" not in str(caught.value)


def test_a_folder_without_a_submission_is_named(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_submission(tmp_path / "none")
    with pytest.raises(InputError, match=r"no submission\.yaml"):
        read_submission(tmp_path)


def test_what_is_no_folder_to_write_is_named_before_anything_runs(folder, quick):
    with pytest.raises(InputError, match=r"submission\.yaml: not a folder"):
        check_submission(folder, folder / "submission.yaml", drives=1)


def test_nothing_of_the_folder_runs_in_the_judge(folder, quick):
    """Hydra imports plugins that it finds, and a program needs none."""
    (folder / "hydra_plugins.py").write_text("raise SystemExit('I am in')\n")
    score, _ = check_submission(folder, drives=1, seed=5)
    assert score.passed
    assert "hydra_plugins" not in sys.modules or "mine" not in str(sys.modules["hydra_plugins"])


def test_a_program_runs_in_a_copy_of_its_folder_and_finds_no_recording(folder, quick):
    before = sorted(p.name for p in folder.iterdir())
    text = (folder / "filter.py").read_text()
    (folder / "filter.py").write_text("open('made.txt', 'w').write('x')\n" + text)
    found = []
    for seed in (5, 6):
        score, out = check_submission(folder, drives=1, seed=seed)
        assert score.passed
        found.append(sorted(out.parents[1].rglob("*.npz")))  # of the checks
    assert sorted(p.name for p in folder.iterdir()) == before
    assert found[0] == found[1]


def test_one_drive_that_fails_leaves_its_class_without_a_ratio(folder, quick):
    text = (folder / "filter.py").read_text()
    (folder / "filter.py").write_text(f"import sys\nsys.path.insert(0, '.')\n{text}")
    score, _ = check_submission(folder, drives=2, seed=5)
    rows = score.rows.copy()
    own = rows.index[rows["choice.estimator"] == "mine"]
    rows.loc[own[0], ["status", "status_detail", "ate_rmse_m"]] = ["failed", "out of luck", None]
    lost = dataclasses.replace(score, rows=rows)
    (line,) = table_of(lost).to_dict("records")
    assert line["failed"] == 1
    assert np.isnan(line["error over odometry's"])
    assert failures(lost) == ["1 drive failed: out of luck (first: rooms, seed 5)"]


def test_a_whole_log_counts_by_its_revised_path(folder, quick):
    score, _ = check_submission(folder, drives=1, seed=5)
    rows = score.rows.copy()
    rows["revised_ate_rmse_m"] = [130.0 if n == "mine" else None for n in rows["choice.estimator"]]
    (line,) = table_of(dataclasses.replace(score, rows=rows)).to_dict("records")
    assert line["error, m"] == pytest.approx(130.0)


def test_scores_of_somebody_else_are_not_overwritten(folder, quick):
    check_submission(folder, drives=1, seed=5)
    check_submission(folder, drives=1, seed=5)
    (folder / "submission.yaml").write_text(SAID.replace("example.org/mine", "example.org/other"))
    with pytest.raises(InputError, match=r"holds the scores of https://example.org/mine"):
        check_submission(folder, drives=1, seed=5)


def test_without_passing_the_checks_nothing_is_driven(folder, quick, monkeypatch):
    failed = [CheckResult("one", False, "wrong")]
    monkeypatch.setattr(submit, "check_estimator", lambda *_, **__: failed)
    score, _ = check_submission(folder, drives=1)
    assert not len(score.rows)
    assert summary(score) == "mine: 1 check failed; no drives, as the checks come first"


@pytest.mark.slow
def test_a_submission_passes_through_all_classes(folder):
    score, _ = check_submission(folder, drives=1, seed=12_345)
    assert score.passed, [check.message for check in score.checks]
    assert set(table_of(score)["board"]) == set(submit.CLASSES)
    assert len(submit.CLASSES) == 6
