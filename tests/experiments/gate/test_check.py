"""The gate: verdicts follow the errors, equal code passes, and every report says the same."""

import dataclasses
import math
import xml.etree.ElementTree as ET
from contextlib import contextmanager
from functools import partial

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from experiments.gate import baseline
from experiments.gate import compare as regress
from experiments.gate import report as regress_report
from experiments.gate.candidate import candidate_rows, write_recordings
from experiments.gate.compare import exchange_p, holm
from experiments.gate.report import run_check
from experiments.gate.suite import (
    ERRORS,
    command_of,
    fingerprint,
    read_suite,
    run_suite,
    suite_path,
)
from experiments.runs.experiment import Experiment
from experiments.runs.paths import results
from sim import se2
from sim.errors import InputError
from sim.formats import assemble, carmen
from sim.formats.tum import write_tum

QUICK = [
    "world=room",
    "world.n_landmarks=0",
    "route.distance_m=2",
    "simulation.physics=kinematic",
    "simulation.rays=exact",
]


def table(name, errors, status="ok"):
    """Rows of (n, repeats) errors, the same for all three."""
    return pd.DataFrame(
        [
            {
                "estimator": name,
                "recording": i,
                "repeat": r,
                "checksum": f"c{i}",
                "fingerprint": 1.0 + i,
                **dict.fromkeys(ERRORS, error),
                "status": status,
            }
            for i, row in enumerate(errors)
            for r, error in enumerate(row)
        ]
    )


def verdicts(then, now, name="e"):
    found = regress.compare({"accepted": table(name, then)}, table(name, now), n_draws=20_000)
    return {f.verdict for f in found}


def of_recordings(rng, n=100):
    return np.exp(rng.standard_normal((n, 1)))


def test_a_fixed_estimator_is_judged_across_recordings():
    rng = np.random.default_rng(0)
    then = of_recordings(rng)
    scatter = np.exp(0.1 * rng.standard_normal(then.shape))
    assert verdicts(then, then) == {"identical"}
    assert verdicts(then, then * (1.0 + 1e-8)) == {"identical"}
    assert verdicts(then, then * scatter * 1.1) == {"worse"}
    assert verdicts(then, then * scatter / 1.1) == {"better"}
    # up here, down there, by the same: another result, but no worse one
    balanced = np.exp(0.1 * np.resize([1.0, -1.0], then.shape))
    assert verdicts(then, then * balanced) == {"changed"}
    # one recording that got much worse does not speak for the others
    spoilt = then.copy()
    spoilt[7] *= 50.0
    assert verdicts(then, spoilt) == {"changed"}


def test_a_random_estimator_is_judged_by_its_own_scatter():
    rng = np.random.default_rng(1)
    difficulty = of_recordings(rng)

    def runs(k, shift=0.0):
        return difficulty * np.exp(shift + 0.2 * rng.standard_normal((len(difficulty), k)))

    assert verdicts(runs(4), runs(2)) == {"equal"}
    assert verdicts(runs(4), runs(2, math.log(1.2))) == {"worse"}
    assert verdicts(runs(4), runs(2, -math.log(1.2))) == {"better"}
    same = runs(4)
    assert verdicts(same, same[:, :2]) == {"identical"}


def test_false_alarms_are_as_rare_as_promised():
    """Of 1000 p values of exchanged skewed runs, the share below each level is the level."""
    rng = np.random.default_rng(2)
    ps = []
    for _ in range(1000):
        runs = rng.standard_exponential((12, 6)) * np.exp(rng.standard_normal((12, 1)))
        ps.append(exchange_p(np.log(runs[:, 2:]), np.log(runs[:, :2]), rng, 1000)[0])
    for level in (0.005, 0.05, 0.5):
        hits = int(np.sum(np.array(ps) <= level))
        assert stats.binomtest(hits, 1000, level).pvalue > 1e-3


def test_exchange_agrees_with_the_exact_permutation_test():
    rng = np.random.default_rng(3)
    for shift, tolerance in ((0.0, 0.05), (1.8, 0.0015)):  # by the normal law; by drawing
        then, now = 0.7 * rng.standard_normal((2, 10, 1))
        now += shift
        signs = np.array(np.meshgrid(*[[-1, 1]] * 10)).reshape(10, -1)
        means = (signs * (now - then)).mean(axis=0)
        exact = np.mean(means >= (now - then).mean() - 1e-12)
        assert exchange_p(then, now, rng, 50_000)[0] == pytest.approx(exact, abs=tolerance)


def test_holm_keeps_the_family():
    assert holm([0.01, 0.04, 0.03], 0.05) == [True, False, False]
    assert holm([0.01, 0.02, 0.03], 0.05) == [True, True, True]
    assert holm([], 0.05) == []


def test_failed_runs_alarm_and_are_reported_once():
    then = table("e", np.ones((5, 1)))
    now = then.copy()
    now.loc[2, [*ERRORS, "status"]] = [math.nan] * 3 + ["ValueError: no"]
    found = regress.compare({"accepted": then}, now)
    assert {f.verdict for f in found} == {"failed"}
    text = regress_report.as_text(found)
    assert text.count("1 of 5 runs fail; recording 2: ValueError: no") == 1


def test_errors_that_became_infinite_alarm():
    then = table("e", np.ones((5, 2)))
    now = then.copy()
    now.loc[4, ERRORS[0]] = math.inf
    found = regress.compare({"accepted": then, "release": then}, now)
    assert {f.verdict for f in found} == {"failed"}
    message = "e: 1 of 10 runs fail; recording 2: errors that are not finite"
    for report in (regress_report.as_text(found), regress_report.as_annotations(found)):
        assert report.count(message) == 1  # of both baselines once
    # where the baseline failed already nothing is new, and the tables say that less was compared
    known = regress.compare({"accepted": now}, now)
    assert {f.verdict for f in known} == {"identical"}
    assert "identical (4 of 5 recordings)" in regress_report.as_text(known)
    assert "identical (4 of 5 recordings)" in regress_report.as_markdown(known)
    assert "of 5" not in regress_report.as_text(regress.compare({"accepted": then}, then))


def test_many_runs_are_exchanged_by_drawing():
    """20 runs can be split in 125 970 ways, 32 in 600 million."""
    rng = np.random.default_rng(6)
    for n_then, n_now in ((12, 8), (16, 16)):
        then, now = (0.2 * rng.standard_normal((6, n)) for n in (n_then, n_now))
        assert 0.01 < exchange_p(then, now, rng, 2000)[0] < 0.99
        assert exchange_p(then, now + 0.2, rng, 2000)[0] < 0.002
        assert exchange_p(then, now - 0.2, rng, 2000)[1] < 0.002


def test_ways_drawn_are_as_those_counted(monkeypatch):
    rng = np.random.default_rng(7)
    runs = rng.standard_exponential((3, 8))
    counted = regress._exchanged_sums(runs, 3, rng)
    monkeypatch.setattr(regress, "_MOST_WAYS", 0)
    drawn = regress._exchanged_sums(runs, 3, rng)
    assert np.allclose(drawn[:, 0], counted[:, 0], rtol=0.0, atol=1e-12)
    for a, b in zip(counted, drawn, strict=True):
        assert stats.ks_2samp(a, b).pvalue > 1e-3
        assert np.isclose(b[:, None], a).any(axis=1).all()


def test_other_recordings_are_refused():
    then = table("e", np.ones((5, 1)))
    other_bits = then.assign(checksum="x", fingerprint=then["fingerprint"] * (1 + 1e-9))
    assert {f.verdict for f in regress.compare({"accepted": then}, other_bits)} == {"identical"}
    for now, words in (
        (then.assign(checksum="x", fingerprint=7.0), "what simulates it has changed"),
        (then.assign(checksum="x", fingerprint=math.nan), "what simulates it has changed"),
        (then.iloc[:4], "other recordings"),
        (then.assign(estimator="f"), "does not know f"),
    ):
        with pytest.raises(InputError, match=words) as refusal:
            regress.compare({"accepted": then}, now)
        assert "--accept" in str(refusal.value)


@pytest.fixture
def small(tmp_path, monkeypatch):
    """A suite of dead reckoning over three recordings, with baselines of its own."""
    path = tmp_path / "small.yaml"
    overrides = "".join(f"\n      - {override}" for override in QUICK)
    path.write_text(
        f"first_seed: 5\nrecordings:\n  room:\n    count: 3\n    overrides:{overrides}\n"
        "estimators:\n  odometry: { recordings: room, repeats: [1, 1], overrides: [] }\n"
    )
    monkeypatch.setattr(baseline, "run_suite", partial(run_suite, n_jobs=1))
    return path


def test_suites_of_ones_own_keep_their_baselines_apart(tmp_path):
    main = baseline.baseline_paths("check")
    assert main == baseline.baseline_paths(str(suite_path("check")))
    assert main["accepted"] == baseline.baseline_folder() / "check.csv"
    names = [
        str(tmp_path / f"{folder}{stem}.yaml")
        for folder in ("", "o/")
        for stem in ("check", "release", "power")
    ]
    files = [path for name in [*names, "check"] for path in baseline.baseline_paths(name).values()]
    assert len(set(files)) == len(files)
    assert baseline.baseline_paths(names[0])["release"] == tmp_path / "check.baselines/release.csv"


def test_a_damaged_baseline_is_called_damaged(tmp_path):
    path, sound = tmp_path / "b.csv", table("e", np.full((4, 2), 0.25))
    baseline.write_baseline(baseline.Baseline(sound, ("why",)), path)
    text = path.read_text()
    back = baseline.read_baseline(path)
    assert back.history == ("why",)
    pd.testing.assert_frame_equal(back.rows, sound, check_dtype=False)
    lines = text.splitlines(keepends=True)
    for damaged, why in (
        ("".join(lines[:-2]), "cut short at 6 rows"),
        ("".join(lines[1:])[:-9], "cut short"),  # as old files, which do not say how many
        ("".join([*lines[1:], lines[-1]]), "two rows of e, recording 3, repeat 1"),
        ("".join(lines[1:-1]), "rows of e are missing"),
        (text.replace("0.25", "abc", 1), "ate_rmse_m 'abc' is no number"),
        (text.replace("c1,2", "c1,x", 1), "fingerprint 'x' is no number"),
        (text.replace("c1,2", "c1,", 1), "a row without fingerprint"),
        (text.replace("e,1,", "e,,", 1), "a row without recording"),
        (text.replace("c1,2", ",2", 1), "a row without checksum"),
        (text.replace("fingerprint", "finger"), "no column fingerprint"),
        ("", "No columns"),
        (text.replace("0.25", '"', 1), "EOF"),
    ):
        path.write_text(damaged)
        with pytest.raises(InputError, match=f"damaged.*{why}.*git checkout -- ") as refusal:
            baseline.read_baseline(path)
        assert "\n" not in str(refusal.value)
        assert "--accept" not in str(refusal.value)


def no_run(*_, **__):
    raise AssertionError("ran")


def test_baselines_are_read_before_the_suite_runs(small, monkeypatch):
    monkeypatch.setattr(baseline, "run_suite", no_run)
    for path in baseline.baseline_paths(str(small)).values():
        path.parent.mkdir(exist_ok=True)
        path.write_text("estimator\ne\n")
    with pytest.raises(InputError, match="damaged"):
        baseline.accept(str(small), "reason")
    with pytest.raises(InputError, match="damaged"):
        baseline.check(str(small))


def test_one_estimator_alone_makes_no_baseline(small, monkeypatch, capsys):
    small.write_text(small.read_text() + "  second: { recordings: room, repeats: [1, 1] }\n")
    paths = baseline.baseline_paths(str(small))
    rows = pd.concat([table("odometry", np.ones((3, 1))), table("second", np.ones((3, 1)))])
    accepted = baseline.Baseline(rows)
    monkeypatch.setattr(baseline, "run_suite", no_run)
    for missing in ("accepted", "release"):
        with pytest.raises(InputError, match=f"{paths[missing].name}.*without --only"):
            baseline.accept(str(small), "reason", ["odometry"])
        baseline.write_baseline(accepted, paths["accepted"])
    assert not paths["release"].exists()
    # and a check says that the release is missing
    monkeypatch.setattr(baseline, "run_suite", lambda *_, **__: rows)
    assert not regress_report.run_check(str(small), None)
    warning = capsys.readouterr().err
    assert "release.csv: no release baseline" in warning
    assert "--accept REASON --release" in warning


def test_failures_are_not_accepted(small, monkeypatch):
    rows = table("odometry", np.full((3, 1), math.inf))
    monkeypatch.setattr(baseline, "run_suite", lambda *_, **__: rows)
    with pytest.raises(InputError, match=r"recording 0 \(errors that are not finite\)"):
        baseline.accept(str(small), "reason")


def test_accept_check_worsen_accept(small, monkeypatch, capsys):
    with pytest.raises(InputError, match="needs a reason"):
        baseline.accept(str(small), " ")
    with pytest.raises(InputError, match="no baseline yet"):
        baseline.check(str(small))
    with pytest.raises(InputError, match="no estimator ekf; it has odometry"):
        baseline.check(str(small), ["ekf"])
    accepted = baseline.accept(str(small), "first")
    assert [path.name for path in accepted.written] == ["check.csv", "release.csv"]
    assert not accepted.findings
    assert {f.verdict for f in baseline.check(str(small))} == {"identical"}

    @contextmanager
    def fast_clock(estimator, rng):
        step = estimator.step
        estimator.step = lambda frame: step(
            dataclasses.replace(frame, wheel_increments_m=1.5 * frame.wheel_increments_m)
        )
        yield estimator

    def faulty(suite, repeats, **options):
        return run_suite(suite, repeats, **options, planted={"odometry": fast_clock}, n_jobs=1)

    monkeypatch.setattr(baseline, "run_suite", faulty)
    found = baseline.check(str(small))
    assert {f.baseline for f in found if f.alarms} == {"accepted", "release"}
    assert all(then < now for f in found for _, then, now in f.worst)
    # what is accepted is shown, and passes from then on; the release has to be asked for
    capsys.readouterr()
    assert not regress_report.run_check(str(small), "longer wheels")
    shown = capsys.readouterr().out
    assert "accepted: " in shown
    assert "copied" not in shown
    assert "odometry, position error worse by" in shown
    assert f'estima check --suite {small} --only odometry --accept "REASON" --release' in shown
    assert {f.baseline for f in baseline.check(str(small)) if f.alarms} == {"release"}
    again = baseline.accept(str(small), "longer wheels", release=True)
    assert [path.name for path in again.written] == ["check.csv", "release.csv"]
    assert not any(f.alarms for f in baseline.check(str(small)))
    reasons = {
        key: [line.rsplit(": ", 1)[1] for line in baseline.read_baseline(path).history]
        for key, path in baseline.baseline_paths(str(small)).items()
    }
    assert reasons == {
        "accepted": ["first", "longer wheels", "longer wheels"],
        "release": ["first", "longer wheels"],
    }


def test_a_worsening_names_its_worst_recordings_and_how_to_see_them(small, monkeypatch, capsys):
    first_seed = read_suite(small).first_seed
    rows = run_suite(read_suite(small), {"odometry": 1}, n_jobs=1)
    baseline.accept(str(small), "first")
    worse = rows.copy()
    worse[list(ERRORS)] *= np.array([1.2, 1.5, 1.3])[:, None]
    monkeypatch.setattr(baseline, "run_suite", lambda *_, **__: worse)
    assert regress_report.run_check(str(small), None)
    shown = capsys.readouterr().out
    seeds = [line.split(":")[0] for line in shown.splitlines() if line.startswith("odometry, seed")]
    assert seeds == [f"odometry, seed {first_seed + i}" for i in (1, 2, 0)]
    picture = results() / "runs" / "check" / f"odometry_{first_seed + 1}.png"
    assert picture.exists()
    assert f"estimator=odometry seed={first_seed + 1} world_seed={first_seed + 1}" in shown


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
        poses = assemble.rolled(made.wheels, made.robot.track_m)
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
    with pytest.raises(InputError, match="made elsewhere; check by --candidate DIR"):
        read_suite(elsewhere).of(["mine"]).made(elsewhere=False)
    with pytest.raises(InputError, match="marked `elsewhere: true`"):
        baseline.check(str(small), candidate=tmp_path)


def test_recordings_of_the_check_turn():
    """On a straight line a wrong track, and much else, would go unseen."""
    suite = read_suite(suite_path("check"))
    for group, overrides in suite.overrides.items():
        seed = suite.first_seed
        read = Experiment.compose(overrides).replaced(seed=seed, world_seed=seed).recordings()
        for recording in read.robots:
            assert recording.status == "ok"
            turned = np.abs(np.diff(np.unwrap(recording.truth.poses[:, 2]))).sum()
            assert turned > 1.0, group


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("recordings: 3", "a suite holds"),
        ("first_seed: [", "not valid YAML"),
        (
            "first_seed: 1\nrecordings: {a: {count: 1, overrides: []}}\n"
            "estimators: {odometry: {recordings: a, repeats: [1, 1]}}",
            "count must be 2",
        ),
        *(
            (
                f"first_seed: {seed}\nrecordings: {{a: {{count: 2, overrides: {group}}}}}\n"
                f"estimators: {estimators}",
                words,
            )
            for seed, group, estimators, words in (
                ("1", "[]", "{}", "estimators is empty"),
                ("abc", "[]", "{odometry: {recordings: a, repeats: [1, 1]}}", "first_seed must be"),
                ("1", "[1]", "{odometry: {recordings: a, repeats: [1, 1]}}", "list of texts"),
                ("1", "world=room", "{odometry: {recordings: a, repeats: [1, 1]}}", "list of t"),
                (
                    "1",
                    "[]",
                    "{odometry: {recordings: a, repeats: [1, 1], overrides: [1]}}",
                    "list of texts",
                ),
                ("1", "[]", "{odometry: {recordings: [a], repeats: [1, 1]}}", "must be texts"),
                ("1", "[]", "{1: {recordings: a, repeats: [1, 1]}}", "must be texts"),
                ("1", "[]", "{odometry: {recordings: a, repeats: [1.5, 1]}}", "repeats must lie"),
                ("1", "[]", "{odometry: {recordings: a, repeats: [x, 1]}}", "repeats must lie"),
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
            "repeats must lie",
        ),
    ],
)
def test_wrong_suites_are_refused_in_one_line(tmp_path, text, words):
    path = tmp_path / "s.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as refusal:
        read_suite(path)
    assert "\n" not in str(refusal.value)


def test_fingerprints_distinguish_recordings_and_ignore_rounding(small):
    from tests.fixtures.fakes import circle

    recording = circle()
    wheels = recording.wheels
    assert fingerprint(recording) == fingerprint(recording)
    rounded = dataclasses.replace(wheels, position_m=wheels.position_m * (1.0 + 1e-13))
    nudged = wheels.position_m.copy()
    nudged[len(nudged) // 2] += 1e-2
    for log, is_same in ((rounded, True), (dataclasses.replace(wheels, position_m=nudged), False)):
        other = fingerprint(dataclasses.replace(recording, wheels=log))
        assert (abs(other / fingerprint(recording) - 1.0) < regress.ROUNDING) == is_same


def findings():
    rng = np.random.default_rng(4)
    then = of_recordings(rng)
    now = pd.concat(
        [
            table("worse <&>", then * 1.2 * np.exp(0.05 * rng.standard_normal(then.shape))),
            table("better", then * 0.8 * np.exp(0.05 * rng.standard_normal(then.shape))),
            table("same", then),
        ]
    )
    baseline = pd.concat([table(name, then) for name in ("worse <&>", "better", "same")])
    found = regress.compare({"accepted": baseline}, now)
    return [dataclasses.replace(each, worst=()) for each in found]  # of no suite


def test_reports_agree(monkeypatch, tmp_path, capsys):
    found = findings()
    finds = regress_report.smallest_found()
    assert all(share > 0.0 for share in finds.values())
    text, page = (
        report(found, finds) for report in (regress_report.as_text, regress_report.as_markdown)
    )
    assert "finds" in text
    assert "finds" in page
    for report in (text, page):
        assert "worse: worse <&>" in report
        assert "better: better" in report
        assert "1.000" in report
    notes = regress_report.as_annotations(found).splitlines()
    assert len(notes) == 6
    assert sum(note.startswith("::error title=estima check::worse") for note in notes) == 3
    assert all("%25" in note and "% " not in note for note in notes)
    root = ET.fromstring(regress_report.as_junit(found))
    suite = root.find("testsuite")
    assert (suite.get("tests"), suite.get("failures")) == ("9", "3")
    assert {case.get("classname") for case in suite if case.find("failure") is not None} == {
        "accepted.worse <&>"
    }
    step = tmp_path / "step.md"
    monkeypatch.setattr(regress_report, "check", lambda *_: found)
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(step))
    junit, summary = tmp_path / "j.xml", tmp_path / "s.md"
    assert regress_report.run_check("check", None, junit=junit, summary=summary)
    assert "::error" in capsys.readouterr().out
    assert step.read_text() == summary.read_text() == page
    assert ET.parse(junit).getroot().tag == "testsuites"
    with pytest.raises(InputError, match="--release goes with"):
        regress_report.run_check("check", None, release=True)


def test_the_power_of_the_main_suite_is_not_stated_of_others(small, monkeypatch, capsys):
    monkeypatch.setattr(regress_report, "check", lambda *_: findings())
    regress_report.run_check("check", None)
    assert "finds" in capsys.readouterr().out
    regress_report.run_check(str(small), None)
    assert "finds" not in capsys.readouterr().out
    assert "finds" not in regress_report.as_markdown(findings())


def test_the_interval_is_that_of_the_test():
    """Beside every verdict at 0.05 stands an interval without zero, and by how much it improved."""
    rng = np.random.default_rng(8)
    then, p_of = of_recordings(rng, 30), {}
    noise = 0.1 * rng.standard_normal((30, 1))
    for shift in np.linspace(-0.06, 0.06, 61):
        now = then * np.exp(noise - noise.mean() + shift)
        for found in regress.compare({"accepted": table("e", then)}, table("e", now))[:1]:
            p_of[shift] = min(found.p_general)
            assert (found.verdict in ("worse", "better")) == (found.low > 1.0 or found.high < 1.0)
            if found.verdict in ("worse", "better"):
                words = regress_report.sentence(found)
                size = 100.0 * abs(math.expm1(shift))
                assert f"{found.verdict} by {size:.1f} % (90 % interval: " in words
                assert "-" not in words
    assert any(0.025 < p <= 0.05 for p in p_of.values())  # where a 95 % interval holds zero


def test_messages_are_made_printable(small):
    @contextmanager
    def broken(estimator, rng):
        raise ValueError("a\x00b\x1b[31m\ud800\ufffe\r<c> \u00e9")
        yield estimator

    now = run_suite(read_suite(small), {"odometry": 1}, planted={"odometry": broken}, n_jobs=1)
    raw = now.assign(status="ValueError: a\x00b\x1b[31m\x85\ufffe\r<c> \u00e9")
    then = now.assign(status="ok", **dict.fromkeys(ERRORS, 1.0))
    found = regress.compare({"accepted": then}, raw)
    assert regress.compare({"accepted": then}, now)[0].message == found[0].message.translate(
        {0: "?", 0x1B: "?", 0x85: "?", 0xFFFE: "?", 13: "?"}
    )
    failures = ET.fromstring(regress_report.as_junit(found)).findall(".//failure")
    assert len(failures) == 3
    assert failures[0].get("message").endswith("ValueError: a?b?[31m???<c> \u00e9")
    for report in (regress_report.as_text, regress_report.as_annotations):
        assert "a?b?[31m???<c>" in report(found)
        assert all(c.isprintable() or c == "\n" for c in report(found))


@pytest.mark.parametrize("where", ["junit", "summary", "step"])
def test_reports_that_cannot_be_written_are_refused_before_the_run(where, tmp_path, monkeypatch):
    monkeypatch.setattr(regress_report, "check", no_run)
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "report", tmp_path):
        options = {where: path}
        if options.pop("step", None):
            monkeypatch.setenv("GITHUB_ACTIONS", "true")
            monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(path))
        with pytest.raises(InputError, match="cannot write a report there"):
            regress_report.run_check("check", None, **options)


def test_a_folder_is_made_for_the_job_summary(tmp_path, monkeypatch):
    page = tmp_path / "new" / "step.md"
    monkeypatch.setattr(regress_report, "check", lambda *_: findings())
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(page))
    assert regress_report.run_check("check", None)
    assert page.read_text().startswith("## estima check")
