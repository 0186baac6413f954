"""The gate: verdicts follow the errors, equal code passes, and every report says the same."""

import dataclasses
import math
from contextlib import contextmanager

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from experiments.gate import baseline
from experiments.gate import compare as regress
from experiments.gate import report as regress_report
from experiments.gate.compare import exchange_p, holm
from experiments.gate.suite import (
    ERRORS,
    read_suite,
    run_suite,
    suite_path,
)
from experiments.runs.paths import results
from sim.errors import InputError
from tests.experiments.gate.conftest import no_run, of_recordings, table


def verdicts(then, now, name="e"):
    found = regress.compare({"accepted": table(name, then)}, table(name, now))
    return {f.verdict for f in found}


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
        ps.append(exchange_p(np.log(runs[:, 2:]), np.log(runs[:, :2]), rng)[0])
    for level in (0.005, 0.05, 0.5):
        hits = int(np.sum(np.array(ps) <= level))
        assert stats.binomtest(hits, 1000, level).pvalue > 1e-3


def test_exchange_agrees_with_the_exact_permutation_test(monkeypatch):
    rng = np.random.default_rng(3)
    for shift in (0.0, 0.5, 1.8):
        then, now = 0.7 * rng.standard_normal((2, 10, 1))
        now += shift
        signs = np.array(np.meshgrid(*[[-1, 1]] * 10)).reshape(10, -1)
        means = (signs * (now - then)).mean(axis=0)
        exact = np.mean(means >= (now - then).mean() - 1e-12)
        assert exchange_p(then, now, rng)[0] == pytest.approx(exact, abs=1e-12)
        monkeypatch.setattr(regress, "_MOST_COUNTED", 1)
        assert exchange_p(then, now, rng)[0] == pytest.approx(exact, rel=0.3)
        monkeypatch.undo()


def test_saddle_point_tails_hold_far_out():
    """Of skewed runs, against a count of all 15**6 ways; at the extremes the bound is exact."""
    rng = np.random.default_rng(9)
    sums = rng.standard_exponential((6, 15))
    totals = np.zeros(1)
    for row in sums:
        totals = np.add.outer(totals, row).ravel()
    order = np.sort(sums, axis=1)
    for quantile in (-3, -5, 1, 8):
        seen = order.copy()
        seen[:, [0, quantile]] = seen[:, [quantile, 0]]
        exact = np.mean(totals >= seen[:, 0].sum() - 1e-9)
        assert regress._saddle_point_p(seen) == pytest.approx(exact, rel=0.1)
    greatest = order[:, ::-1]
    assert regress._saddle_point_p(greatest) == pytest.approx(15.0**-6, rel=1e-3)
    assert regress._saddle_point_p(np.repeat(greatest, 20, axis=0)) < 1e-100


@pytest.mark.parametrize("n_estimators", [14, 100, 500])
def test_ten_times_worse_is_worse_however_many_are_tested(n_estimators):
    rng = np.random.default_rng(10)
    then, now = (0.2 * rng.standard_normal((40, n)) for n in (4, 2))
    finding = regress.examine(("e", "ate_rmse_m", "accepted"), np.exp(then), np.exp(now + 2.3), rng)
    everyone = [
        dataclasses.replace(finding, estimator=f"e{i}", error=e, baseline=b)
        for i in range(n_estimators)
        for e in ERRORS
        for b in ("accepted", "release")
    ]
    assert {f.verdict for f in regress.judge(everyone)} == {"worse"}


def test_two_baselines_that_hold_the_same_are_one_claim():
    one = regress.Finding(
        "e",
        "ate_rmse_m",
        "accepted",
        9,
        9,
        1.1,
        1.0,
        1.2,
        (0.0, 1.0),
        (0.7 * regress.ALPHA / 2.0, 1.0),
        regress.Change.CHANGED,
    )
    same, other = (dataclasses.replace(one, baseline="release", ratio=r) for r in (1.1, 1.2))
    assert {f.verdict for f in regress.judge([one, same])} == {"worse"}
    assert {f.verdict for f in regress.judge([one, other])} == {"changed"}


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
        assert 0.01 < exchange_p(then, now, rng)[0] < 0.99
        assert exchange_p(then, now + 0.2, rng)[0] < 0.002
        assert exchange_p(then, now - 0.2, rng)[1] < 0.002


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
        (then.assign(estimator="f"), "has no f"),
    ):
        with pytest.raises(InputError, match=words) as refusal:
            regress.compare({"accepted": then}, now)
        assert "accept a check with a reason" in str(refusal.value)


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
        (text.replace("0.25", "abc", 1), "ate_rmse_m 'abc' is not a number"),
        (text.replace("c1,2", "c1,x", 1), "fingerprint 'x' is not a number"),
        (text.replace("c1,2", "c1,", 1), "a row without fingerprint"),
        (text.replace("e,1,", "e,,", 1), "a row without recording"),
        (text.replace("c1,2", ",2", 1), "a row without checksum"),
        (text.replace("fingerprint", "finger"), "no column fingerprint"),
        ("", "No columns"),
        (text.replace("0.25", '"', 1), "EOF"),
        (text.replace("0.25", "-1", 1), "ate_rmse_m -1 is below zero"),
        (text.replace("0.25", "", 1), "a row that did not fail without ate_rmse_m"),
        (text.replace(",ok", ",banana", 1), "status 'banana' is unknown"),
    ):
        path.write_text(damaged)
        with pytest.raises(InputError, match=f"damaged.*{why}.*git checkout -- ") as refusal:
            baseline.read_baseline(path)
        assert "\n" not in str(refusal.value)
        assert "accept" not in str(refusal.value)


def test_baselines_are_read_before_the_suite_runs(small, monkeypatch):
    monkeypatch.setattr(baseline, "run_suite", no_run)
    for path in baseline.baseline_paths(str(small)).values():
        path.parent.mkdir(exist_ok=True)
        path.write_text("estimator\ne\n")
    with pytest.raises(InputError, match="damaged"):
        baseline.accept(str(small), "reason")
    with pytest.raises(InputError, match="damaged"):
        baseline.check(str(small))


def test_an_estimator_without_a_baseline_is_named_before_the_suite_runs(small, monkeypatch):
    monkeypatch.setattr(baseline, "run_suite", no_run)
    others = baseline.Baseline(table("e", np.full((4, 2), 0.25)), ("why",))
    names = ", ".join(e.name for e in read_suite(small).estimators)
    for path in baseline.baseline_paths(str(small)).values():
        baseline.write_baseline(others, path)
    with pytest.raises(InputError, match=f"the accepted baseline has no {names}; accept a check"):
        baseline.check(str(small))
    accepted = baseline.baseline_paths(str(small))["accepted"]
    mine = [table(e.name, np.full((4, 2), 0.25)) for e in read_suite(small).estimators]
    baseline.write_baseline(baseline.Baseline(pd.concat(mine), ("why",)), accepted)
    with pytest.raises(InputError, match=r"the release baseline has no .* and pin the release"):
        baseline.check(str(small))


def test_one_estimator_alone_makes_no_baseline(small, monkeypatch, capsys):
    small.write_text(small.read_text() + "  second: { recordings: room, repeats: [1, 1] }\n")
    paths = baseline.baseline_paths(str(small))
    rows = pd.concat([table("odometry", np.ones((3, 1))), table("second", np.ones((3, 1)))])
    accepted = baseline.Baseline(rows)
    monkeypatch.setattr(baseline, "run_suite", no_run)
    for missing in ("accepted", "release"):
        with pytest.raises(InputError, match=f"{paths[missing].name}.*accept the whole suite"):
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
    worse[list(ERRORS)] *= np.array([1.30, 1.34, 1.32])[:, None]
    monkeypatch.setattr(baseline, "run_suite", lambda *_, **__: worse)
    assert regress_report.run_check(str(small), None)
    shown = capsys.readouterr().out
    seeds = [line.split(":")[0] for line in shown.splitlines() if line.startswith("odometry, seed")]
    assert seeds == [f"odometry, seed {first_seed + i}" for i in (1, 2, 0)]
    picture = results() / "runs" / "check" / f"odometry_{first_seed + 1}.png"
    assert picture.exists()
    assert f"estimator=odometry seed={first_seed + 1} world_seed={first_seed + 1}" in shown


def test_the_command_that_accepts_has_the_options_of_the_check(monkeypatch, tmp_path):
    monkeypatch.setenv("ESTIMA_TRUST", "1")
    said = regress_report.command_again("my suite.yaml", [], tmp_path / "out", tmp_path / "mine")
    assert said == (
        f"estima --trust check --suite 'my suite.yaml' --candidate {tmp_path}/out "
        f"--config-dir {tmp_path}/mine"
    )
    monkeypatch.delenv("ESTIMA_TRUST")
    assert regress_report.command_again("check", [], None, None) == "estima check"
