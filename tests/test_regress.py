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

from experiments import regress, regress_report
from experiments.build import default_cache, make_recording
from experiments.compose import compose
from experiments.regress import exchange_p, holm
from experiments.suite import ERRORS, fingerprint, read_suite, run_suite, suite_path
from sim.errors import InputError

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


def test_failed_runs_alarm_and_are_told_once():
    then = table("e", np.ones((5, 1)))
    now = then.copy()
    now.loc[2, [*ERRORS, "status"]] = [math.nan] * 3 + ["ValueError: no"]
    found = regress.compare({"accepted": then}, now)
    assert {f.verdict for f in found} == {"failed"}
    text = regress_report.as_text(found)
    assert text.count("1 of 5 runs fail; recording 2: ValueError: no") == 1


def test_other_recordings_are_refused():
    then = table("e", np.ones((5, 1)))
    other_bits = then.assign(checksum="x", fingerprint=then["fingerprint"] * (1 + 1e-9))
    assert {f.verdict for f in regress.compare({"accepted": then}, other_bits)} == {"identical"}
    for now, words in (
        (then.assign(checksum="x", fingerprint=7.0), "what simulates it has changed"),
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
    monkeypatch.setattr(regress, "BASELINES", tmp_path / "baselines")
    monkeypatch.setattr(regress, "run_suite", partial(run_suite, n_jobs=1))
    (tmp_path / "baselines").mkdir()
    return path


def test_accept_check_worsen_accept(small, monkeypatch):
    with pytest.raises(InputError, match="needs a reason"):
        regress.accept(str(small), " ")
    with pytest.raises(InputError, match="no baseline yet"):
        regress.check(str(small))
    with pytest.raises(InputError, match="no estimator ekf; it has odometry"):
        regress.check(str(small), ["ekf"])
    written = regress.accept(str(small), "first")
    assert [path.name for path in written] == ["small.csv", "small_release.csv"]
    assert {f.verdict for f in regress.check(str(small))} == {"identical"}

    @contextmanager
    def fast_clock(estimator, rng):
        step = estimator.step
        estimator.step = lambda frame: step(
            dataclasses.replace(frame, wheel_increments_m=1.5 * frame.wheel_increments_m)
        )
        yield estimator

    def faulty(suite, repeats, **options):
        return run_suite(suite, repeats, **options, planted={"odometry": fast_clock}, n_jobs=1)

    monkeypatch.setattr(regress, "run_suite", faulty)
    found = regress.check(str(small))
    assert {f.baseline for f in found if f.alarms} == {"accepted", "release"}
    # what is accepted passes from then on, against the release too, and both files say why
    assert len(regress.accept(str(small), "longer wheels")) == 2
    assert not any(f.alarms for f in regress.check(str(small)))
    for path in regress.baseline_paths(str(small)).values():
        history = regress.read_baseline(path).history
        assert [line.rsplit(": ", 1)[1] for line in history] == ["first", "longer wheels"]
    # better than the release: that stays pinned
    monkeypatch.setattr(regress, "run_suite", partial(run_suite, n_jobs=1))
    assert [p.name for p in regress.accept(str(small), "mended")] == ["small.csv"]


def test_suite_of_the_check_is_sound():
    suite = read_suite(suite_path("check"))
    assert len({entry.name for entry in suite.estimators}) == len(suite.estimators) >= 9
    for entry in suite.estimators:
        assert entry.repeats[0] >= entry.repeats[1]


def test_recordings_of_the_check_turn():
    """On a straight line a wrong track, and much else, would go unseen."""
    suite = read_suite(suite_path("check"))
    for group, overrides in suite.overrides.items():
        config = compose(overrides)
        config["seed"] = config["world_seed"] = suite.first_seed
        recording = make_recording(config, default_cache())
        assert recording.status == "ok"
        turned = np.abs(np.diff(np.unwrap(recording.truth.poses[:, 2]))).sum()
        assert turned > 1.0, group


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("recordings: 3", "a suite holds"),
        ("first_seed: [", "cannot read"),
        (
            "first_seed: 1\nrecordings: {a: {count: 1, overrides: []}}\nestimators: {}",
            "count must be 2",
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
def test_wrong_suites_are_told_in_a_line(tmp_path, text, words):
    path = tmp_path / "s.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as refusal:
        read_suite(path)
    assert "\n" not in str(refusal.value)


def test_fingerprints_tell_recordings_apart_and_forgive_rounding(small):
    from tests.fakes import circle

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
    return regress.compare({"accepted": baseline}, now)


def test_reports_agree(monkeypatch, tmp_path, capsys):
    found = findings()
    text, page = regress_report.as_text(found), regress_report.as_markdown(found)
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
