"""Suites, and trajectories that were made elsewhere."""

import dataclasses
import re
from functools import partial

import numpy as np
import pytest
from hydra.errors import MissingConfigException

from experiments.gate import baseline
from experiments.gate import compare as regress
from experiments.gate.candidate import candidate_rows, write_recordings
from experiments.gate.report import run_check
from experiments.gate.suite import (
    command_of,
    fingerprint,
    read_suite,
    run_suite,
    suite_path,
)
from experiments.runs.experiment import Experiment
from sim import se2
from sim.errors import InputError
from sim.formats import assemble, carmen
from sim.formats.tum import write_tum
from sim.team import Team
from tests.experiments.gate.conftest import QUICK
from tests.fixtures.fakes import circle


def test_suite_of_the_check_is_sound():
    suite = read_suite(suite_path("check"))
    assert len({entry.name for entry in suite.estimators}) == len(suite.estimators) >= 9
    for entry in suite.estimators:
        assert entry.repeats[0] >= entry.repeats[1]
    estimators = {entry.estimator for entry in suite.estimators}
    assert {"ekf_icp_paper", "fastslam_paper", "fixed_lag", "graph_slam"} <= estimators
    assert any("study=teams" in suite.overrides[e.recordings] for e in suite.estimators)
    by_engine = [
        e for e in suite.estimators if "simulation.physics=bullet" in suite.overrides[e.recordings]
    ]
    assert len(by_engine) >= 3


def test_an_entry_may_name_its_estimator(tmp_path):
    """Two entries run one estimator over different recordings, each with rows of its own."""
    group = "{count: 2, overrides: [world=empty, route=linear_4, simulation.physics=kinematic]}"
    path = tmp_path / "mine.yaml"
    path.write_text(
        f"first_seed: 7\nrecordings: {{a: {group}, b: {group}}}\nestimators:\n"
        "  odometry: {recordings: a, repeats: [1, 1]}\n"
        "  again: {estimator: odometry, recordings: b, repeats: [1, 1], "
        "overrides: [estimator.kr=1e-3]}\n"
    )
    suite = read_suite(path)
    command = command_of(suite, "again", 7)
    assert "estimator=odometry" in command
    assert "estimator.kr=1e-3" in command
    rows = run_suite(suite, {"odometry": 1, "again": 1}, n_jobs=1)
    assert rows.groupby("estimator").size().to_dict() == {"again": 2, "odometry": 2}
    assert set(rows["status"]) == {"ok"}


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A suite whose trajectories are made elsewhere, and a folder of them by dead reckoning."""
    path = tmp_path / "mine.yaml"
    overrides = ", ".join([*QUICK, "sensors=hokuyo", "sensors.laser.n_beams=11"])
    path.write_text(
        f"first_seed: 5\nrecordings: {{room: {{count: 6, overrides: [{overrides}]}}}}\n"
        "estimators:\n"
        "  mine: {recordings: room, repeats: [2, 2], elsewhere: true}\n"
        "  odometry: {recordings: room, repeats: [1, 1]}\n"
    )
    monkeypatch.setattr(baseline, "run_suite", partial(run_suite, n_jobs=1))
    return path


def trajectories(inputs, folder, noise_m=0.0, seed=0):
    """Two repeats a recording of its odometry, moved by noise of a repeat's own."""
    rng = np.random.default_rng(seed)
    for log in sorted(inputs.glob("*.log")):
        made = carmen.to_recording(carmen.read_carmen(log))
        x0, y0, heading0 = np.loadtxt(log.with_suffix(".start.txt"), max_rows=1)
        poses = assemble.pose_by_wheels(made.wheels, made.robot.track_m)
        for repeat in range(2):
            drift = (0.01 * rng.random() + noise_m) * np.linspace(0, 1, len(poses))
            moved = se2.compose(np.array([x0, y0, heading0]), poses)
            moved[:, 0] += drift
            write_tum(folder / f"{log.stem}.{repeat}.tum", made.wheels.stamps, moved)


@pytest.mark.slow
def test_trajectories_made_elsewhere_are_judged(elsewhere, tmp_path, capsys):
    inputs, then, now, worse = (tmp_path / name for name in ("in", "then", "now", "worse"))
    suite = read_suite(elsewhere).made(elsewhere=True)
    assert write_recordings(suite, inputs) == 6
    assert len(list(inputs.glob("*.start.txt"))) == 6
    for folder, noise_m, seed in ((then, 0.0, 0), (now, 0.0, 1), (worse, 0.5, 2)):
        trajectories(inputs, folder, noise_m, seed)
    name = str(elsewhere)
    with pytest.raises(InputError, match="no baseline yet"):
        run_check(name, None, candidate=then)
    run_check(name, "first", candidate=then)
    run_check(name, "first", ["odometry"], release=True)
    assert not run_check(name, None, ["odometry"])
    assert not run_check(name, None, candidate=now)
    assert run_check(name, None, candidate=worse)
    assert "worse" in capsys.readouterr().out
    (now / "room_7.1.tum").unlink()
    (now / "room_6.0.tum").write_text("0 1 2\n")
    lines = (now / "room_8.0.tum").read_text().splitlines()
    (now / "room_8.0.tum").write_text("\n".join(lines[: len(lines) // 2]) + "\n")
    rows = candidate_rows(suite, now, {"mine": 2}).set_index(["recording", "repeat"])["status"]
    assert (rows == "ok").sum() == 9
    assert rows[6, 0].startswith("unreadable")
    assert rows[7, 1].startswith("missing")
    assert rows[8, 0].startswith("gap")
    assert run_check(name, None, candidate=now)
    assert "3 of 12 runs fail" in capsys.readouterr().out


def test_what_is_no_trajectory_of_the_suite_is_told(elsewhere, tmp_path, capsys):
    """Whatever lies in the folder is a run that failed, or is named, or is passed over."""
    inputs, folder = tmp_path / "in", tmp_path / "out"
    suite = read_suite(elsewhere).made(elsewhere=True)
    write_recordings(suite, inputs)
    trajectories(inputs, folder)
    for name, content in (
        ("room_5.0.tum", b""),
        ("room_6.0.tum", bytes(range(256)) * 9),
        ("room_7.0.tum", None),
        ("room_8.0.mcap", b"\x89MCAP0\r\n no more"),
        ("room_99.0.tum", b"0 0 0 0 0 0 0 1\n"),
        ("room_9.7.tum", b""),
        ("room_9.0.csv", b"second choice"),
        ("map.txt", b"of a run's own"),
        ("readme.md", b"# Mine"),
        ("plots", None),
    ):
        (folder / name).unlink(missing_ok=True)
        if content is None:
            (folder / name).mkdir()
        else:
            (folder / name).write_bytes(content)
    (folder / "room_8.0.tum").unlink()
    rows = candidate_rows(suite, folder, {"mine": 2}).set_index(["recording", "repeat"])["status"]
    assert (rows == "ok").sum() == 8
    for seed in (5, 6, 7, 8):
        assert rows[seed, 0].startswith("unreadable")
        assert "\n" not in rows[seed, 0]
    told = capsys.readouterr().err
    assert "of no run, left out: map.txt, room_9.0.csv, room_9.7.tum, room_99.0.tum\n" in told


def test_what_is_made_elsewhere_needs_its_trajectories(elsewhere, small, tmp_path):
    with pytest.raises(InputError, match="no trajectories here"):
        baseline.accept(str(elsewhere), "why", candidate=tmp_path / "none")
    with pytest.raises(InputError, match="made elsewhere; check a candidate"):
        read_suite(elsewhere).select(["mine"]).made(elsewhere=False)
    with pytest.raises(InputError, match="marked `elsewhere: true`"):
        baseline.check(str(small), candidate=tmp_path)


@pytest.mark.slow
def test_recordings_of_the_check_turn():
    """On a straight line a wrong track, and much else, would go unseen."""
    suite = read_suite(suite_path("check"))
    for group, overrides in suite.overrides.items():
        seed = suite.first_seed
        read = Experiment.compose(overrides).with_values(seed=seed, world_seed=seed).recordings()
        for recording in read.robots:
            assert recording.status == "ok"
            turned = np.abs(np.diff(np.unwrap(recording.truth.poses[:, 2]))).sum()
            assert turned > 1.0, group


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("recordings: 3", "conf/suite/check.yaml is an example"),
        ("first_seed: [", "not valid YAML"),
        (
            "first_seed: 1\nrecordings: {a: {count: 1, overrides: []}}\n"
            "estimators: {odometry: {recordings: a, repeats: [1, 1]}}",
            "count must be a whole number, at least 2",
        ),
        *(
            (
                f"first_seed: {seed}\nrecordings: {{a: {{count: 2, overrides: {group}}}}}\n"
                f"estimators: {estimators}",
                words,
            )
            for seed, group, estimators, words in (
                ("1", "[]", "{}", "estimators must be a mapping"),
                ("abc", "[]", "{odometry: {recordings: a, repeats: [1, 1]}}", "first_seed must be"),
                ("1", "[1]", "{odometry: {recordings: a, repeats: [1, 1]}}", "list of texts"),
                ("1", "world=room", "{odometry: {recordings: a, repeats: [1, 1]}}", "list of t"),
                (
                    "1",
                    "[]",
                    "{odometry: {recordings: a, repeats: [1, 1], overrides: [1]}}",
                    "list of texts",
                ),
                ("1", "[]", "{odometry: {recordings: [a], repeats: [1, 1]}}", "must be"),
                ("1", "[]", "{1: {recordings: a, repeats: [1, 1]}}", "must be"),
                (
                    "1",
                    "[]",
                    "{odometry: {recordings: a, repeats: [1.5, 1]}}",
                    "two whole numbers from 1 to 1000",
                ),
                (
                    "1",
                    "[]",
                    "{odometry: {recordings: a, repeats: [x, 1]}}",
                    "two whole numbers from 1 to 1000",
                ),
            )
        ),
        (
            "first_seed: 1\nrecordings: {a: {count: 2, overrides: []}}\n"
            "estimators: {odometry: {recordings: b, repeats: [1, 1]}}",
            "known: a",
        ),
        (
            "first_seed: 1\nrecordings: {a: {count: 2, overrides: []}}\n"
            "estimators: {odometry: {recordings: a, repeats: [1, 0]}}",
            "two whole numbers from 1 to 1000",
        ),
    ],
)
def test_wrong_suites_are_refused_in_one_line(tmp_path, text, words):
    path = tmp_path / "s.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as refusal:
        read_suite(path)
    assert "\n" not in str(refusal.value)


def test_fingerprints_distinguish_recordings_and_ignore_rounding():
    recording = circle()
    wheels, sound = recording.wheels, fingerprint(Team((recording,)))
    rounded = dataclasses.replace(wheels, position_m=wheels.position_m * (1.0 + 1e-13))
    nudged = wheels.position_m.copy()
    nudged[len(nudged) // 2] += 1e-2
    for log, is_same in ((rounded, True), (dataclasses.replace(wheels, position_m=nudged), False)):
        other = fingerprint(Team((dataclasses.replace(recording, wheels=log),)))
        assert (abs(other / sound - 1.0) < regress.ROUNDING) == is_same


def test_an_estimator_of_ones_own_folder_is_gated(small, tmp_path, monkeypatch, capsys):
    """A Python file, its option in --config-dir, and a line in the suite; without --trust."""
    monkeypatch.delenv("ESTIMA_TRUST", raising=False)
    (tmp_path / "gated_mine.py").write_text(
        "from estimators.odometry import Odometry\n\n\nclass Mine(Odometry):\n    pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    own = tmp_path / "own"
    (own / "estimator").mkdir(parents=True)
    (own / "estimator" / "mine.yaml").write_text("_target_: gated_mine.Mine\nkr: 3e-5\n")
    small.write_text(small.read_text() + "  mine: { recordings: room, repeats: [1, 1] }\n")
    with pytest.raises(MissingConfigException, match="mine"):
        run_check(str(small), "first")
    run_check(str(small), "first", config_dir=own)
    assert not run_check(str(small), None, config_dir=own)
    assert re.search(r"mine +1.000 +1.000 +1.000 identical", capsys.readouterr().out)
    assert f"--config-dir {own}" in command_of(read_suite(small, own), "mine", 5)
