"""Tuning on a problem whose answer is known, what it refuses, and that it goes on."""

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

import experiments.sweeps.tune as tuning
from experiments.runs.experiment import Experiment
from experiments.sweeps.ranges import Range, Tuning
from sim.errors import InputError
from sim.options import build

STUDY = """# @package _global_
defaults:
  - override /estimator: odometry
route:
  distance_m: 4.0
simulation:
  physics: kinematic
tune:
  trials: {trials}
  seeds: [0, 1, 2, 3, 4, 5]
  estimators:
    odometry:
      window_s: {{ interval: [0.01, 1.0], log: true }}
      integration: {{ choice: [arc, midpoint, euler] }}
hydra:
  sweeper:
    params:
      seed: range({judged},{end})
"""

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def study(tmp_path, monkeypatch):
    """A study whose error is least, and known, at window_s=0.3 by the arc; and the runs made."""
    pytest.importorskip("optuna")
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path / "results"))
    calls = []

    def error_m(experiment):
        settings = experiment.config["estimator"]
        calls.append((experiment.seed, settings["window_s"], settings["integration"]))
        off = math.log(settings["window_s"] / 0.3) ** 2 + 2.0 * (settings["integration"] != "arc")
        return math.exp(off + 0.01 * experiment.seed % 7)

    monkeypatch.setattr(tuning, "error_m", error_m)
    (tmp_path / "study").mkdir()

    def write(trials=12, judged=1000):
        text = STUDY.format(trials=trials, judged=judged, end=judged + 4)
        (tmp_path / "study" / "toy.yaml").write_text(text)
        return str(tmp_path)

    return write, calls


def test_it_finds_what_is_better_and_judges_it_elsewhere(study, tmp_path):
    write, calls = study
    folder = write()
    (tuned,) = tuning.tune("toy", config_dir=folder)
    assert tuned.trials["state"].isin(["complete", "pruned"]).all()
    assert len(tuned.trials) == 12
    assert list(tuned.trials["trial"]) == [*range(1, 13)]
    assert tuned.trials["mean_log_error"].notna().equals(tuned.trials["state"] == "complete")
    best = tuned.trials.loc[tuned.trials["mean_log_error"].idxmin()]
    assert best["best_so_far_m"] == tuned.trials["best_so_far_m"].iloc[-1]
    assert tuned.values.items() <= json.loads(best["options"]).items()
    assert tuned.gain.value < 0.2
    assert tuned.gain.value == pytest.approx(tuned.tuned_m / tuned.default_m)
    assert tuned.n_judged == 4
    assert (np.diff(tuned.trials["best_so_far_m"]) <= 0.0).all()
    assert {seed for seed, *_ in calls} == {*range(6), *range(1000, 1004)}
    assert "pruned" in set(tuned.trials["state"])
    plan = tuning.tuning_of("toy", folder)
    path = tuning.write(tuned, "toy", plan, tmp_path / "estimator")
    assert set(yaml.safe_load(path.read_text())) == {"defaults", *tuned.values}
    with_folder = [f"hydra.searchpath=[file://{tmp_path}]", "estimator=odometry_tuned"]
    settings = Experiment.compose(with_folder).config["estimator"]
    assert settings["window_s"] == tuned.values["window_s"]
    assert settings["kr"] == Experiment.compose([]).config["estimator"]["kr"]
    trials, gains = tuning.trials_table([tuned]), tuning.gains_table([tuned])
    assert json.loads(trials["options"].iloc[0]) == {"window_s": 0.05, "integration": "arc"}
    assert gains["pruned"].iloc[0] == (trials["state"] == "pruned").sum()
    assert tuning.curves(trials, gains).axes[0].get_xlabel() == "trials"


def test_it_goes_on_where_it_ended(study):
    write, calls = study
    list(tuning.tune("toy", config_dir=write(trials=4)))
    n_first = sum(seed < 100 for seed, *_ in calls)
    calls.clear()
    (tuned,) = tuning.tune("toy", config_dir=write(trials=6))
    assert len(tuned.trials) == 6
    assert 0 < sum(seed < 100 for seed, *_ in calls) <= 12  # two trials of six recordings
    calls.clear()
    (again,) = tuning.tune("toy", config_dir=write(trials=6))
    assert not calls
    assert again.gain == tuned.gain
    assert n_first > 0


def test_the_default_wins_where_nothing_is_better(study, monkeypatch):
    monkeypatch.setattr(
        tuning, "error_m", lambda e: 1.0 + (e.config["estimator"]["window_s"] != 0.05)
    )
    (tuned,) = tuning.tune("toy", config_dir=study[0](trials=5))
    assert "window_s" not in tuned.values
    assert tuned.gain.value == 1.0


def test_the_default_is_never_given_up(study):
    write, _ = study
    plan = tuning.tuning_of("toy", write())
    problem = tuning._problem("toy", "odometry", plan, write())

    class Losing:
        def __init__(self, values):
            self.values = values

        def should_prune(self):
            return True

        def report(self, value, step):
            pass

        def suggest_float(self, name, low, high, log):
            return self.values[name]

        def suggest_categorical(self, name, choices):
            return self.values[name]

    assert math.isfinite(tuning._mean_log_error(Losing(problem.default), problem))
    with pytest.raises(pytest.importorskip("optuna").TrialPruned):
        tuning._mean_log_error(Losing({**problem.default, "integration": "euler"}), problem)


def test_a_failed_run_counts(monkeypatch):
    rows = [{"status": "failed"}, {"status": "ok", "ate_rmse_m": math.nan}]
    rows += [{"status": "ok", "ate_rmse_m": 4.0, "revised_ate_rmse_m": 0.5}]
    assert [tuning._answer_m(row) for row in rows] == [tuning.FAILED_M, tuning.FAILED_M, 0.5]


def test_seeds_to_tune_and_to_judge_are_apart(study):
    with pytest.raises(InputError, match="1000 or more"):
        list(tuning.tune("toy", config_dir=study[0](judged=20)))
    with pytest.raises(InputError, match=r"tune\.seeds"):
        build(Tuning, {"trials": 3, "seeds": [1000], "estimators": {"a": {"b": 1}}}, "tune")


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"interval": [1, 0]}, "lower first"),
        ({"interval": [1]}, "lower first"),
        ({"interval": [0, 1], "log": True}, "above 0"),
        ({"interval": [0, 1], "log": "yes"}, "true or false"),
        ({"choice": [1]}, "two plain values"),
        ({"choice": "ab"}, "two plain values"),
        ({"choice": [1, 2], "log": True}, "give {interval"),
        ({}, "give {interval"),
        ({"range": [0, 1]}, "unknown key"),
        (3, "must be"),
    ],
)
def test_wrong_ranges_are_told(settings, complaint):
    content = {"trials": 2, "seeds": [0], "estimators": {"mcl": {"max_particles": settings}}}
    with pytest.raises(InputError, match=complaint) as error:
        build(Tuning, content, "study=toy: tune")
    assert "study=toy: tune.estimators.mcl.max_particles" in str(error.value)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (None, "tune must be a mapping"),
        ({}, "tune.trials is missing"),
        ({"trials": 3, "seeds": [0]}, "tune.estimators is missing"),
        ({"trial": 3}, "unknown key tune.trial; did you mean tune.trials"),
        ({"trials": 3, "seeds": [0], "estimators": {}}, "tune.estimators must be"),
        ({"trials": 3, "seeds": [0], "estimators": {"a": {}}}, "tune.estimators.* must be"),
        ({"trials": 3, "seeds": [0, 0], "estimators": {"a": {"b": 1}}}, "twice"),
    ],
)
def test_a_study_without_a_tune_is_refused(settings, complaint):
    with pytest.raises(InputError, match=complaint):
        build(Tuning, settings, "tune")


def test_what_does_not_fit_the_estimator_is_told_before_any_run(study, tmp_path):
    write, calls = study
    path = tmp_path / "study" / "toy.yaml"
    for old, new, complaint in (
        ("window_s:", "windows:", "no option windows; it has kr"),
        ("[0.01, 1.0]", "[0.1, 1.0]", "must hold the default, 0.05"),
    ):
        folder = write()
        path.write_text(path.read_text().replace(old, new))
        with pytest.raises(InputError, match=complaint):
            list(tuning.tune("toy", config_dir=folder))
    with pytest.raises(InputError, match="does not tune mcl"):
        list(tuning.tune("toy", ["mcl"], config_dir=write()))
    assert not calls


def test_settings_of_a_program_are_options_of_an_option():
    values = {"settings.width": 0.1, "settings.beams": 20, "kind": "online"}
    assert tuning.nested(values) == {"settings": {"width": 0.1, "beams": 20}, "kind": "online"}


def test_other_settings_of_a_program_are_kept(monkeypatch):
    experiment = Experiment.compose(
        [
            "estimator=offline",
            "estimator.command=['true','{out}']",
            "estimator.settings={a: 1, w: 2}",
        ]
    )
    changed = tuning.with_values(experiment, {"settings.w": 3, "kind": "online"})
    assert changed.option("settings") == {"a": 1, "w": 3}
    assert changed.option("kind") == "online"


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("settings.w: { interval: [1, 3] }", "settings.w: give the default"),
        ("settings.a: { interval: [1, 3], default: 2 }", "settings.a: leave out the default"),
        ("settings.w: { interval: [1, 3], default: 5 }", "must hold the default, 5"),
        ("limit_s.w: { interval: [1, 3], default: 2 }", "limit_s has no settings"),
        ("settings.: { interval: [1, 3], default: 2 }", "name the setting after the dot"),
        ("limit_s: { interval: [1.0, 900.0], default: 2.0 }", "leave out the default"),
    ],
)
def test_wrong_ranges_of_settings_are_told(line, complaint, tmp_path):
    pytest.importorskip("optuna")
    folder = tmp_path / "study"
    folder.mkdir()
    text = STUDY.format(trials=2, judged=1000, end=1002).replace("odometry:\n", "offline:\n")
    text = text.replace("/estimator: odometry", "/estimator: offline")
    head, _, tail = text.partition("      window_s")
    ranges = f"      {line}\nhydra" + tail.partition("hydra")[2]
    given = "estimator:\n  command: ['true', '{out}']\n  settings: { a: 1 }\nroute:"
    (folder / "toy.yaml").write_text((head + ranges).replace("route:", given, 1))
    with pytest.raises(InputError, match=complaint):
        list(tuning.tune("toy", config_dir=str(tmp_path)))


def test_whole_defaults_stay_whole():
    assert type(build(Range, {"interval": [1, 9], "default": 5}, "range").default) is int


@pytest.mark.parametrize("source", ["mrpt.cpp", "amcl.cpp"])
def test_the_defaults_of_programs_are_their_own(source):
    text = (ROOT / "tools" / "peers" / source).read_text()
    sections = re.findall(r"const char\* const (\w+) = R\"\((.*?)\)\"", text, re.S)
    known = {
        f"mrpt_{mode.lower()}": dict(re.findall(r"^(\w+)=(\S+)$", body, re.M))
        for mode, body in sections
    } or {"nav2_amcl": dict(re.findall(r"\{\"(\w+)\", ([\d.]+)\}", text))}
    ranges = tuning.tuning_of("peers").estimators
    for name, defaults in known.items():
        for key, allowed in ranges[name].items():
            assert float(defaults[key.removeprefix("settings.")]) == allowed.default


def test_without_optuna_it_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(InputError, match=r"make setup EXTRAS=tune"):
        list(tuning.tune("peers"))


def test_one_that_was_interrupted_keeps_its_trials(study, monkeypatch):
    write, calls = study
    folder, error_m = write(trials=5), tuning.error_m

    def interrupted(experiment):
        if len(calls) == 15:  # in the third trial or a later one
            raise KeyboardInterrupt
        return error_m(experiment)

    monkeypatch.setattr(tuning, "error_m", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(tuning.tune("toy", config_dir=folder))
    monkeypatch.setattr(tuning, "error_m", error_m)
    (tuned,) = tuning.tune("toy", config_dir=folder)
    assert len(tuned.trials) == 5
    assert json.loads(tuned.trials["options"].iloc[0]) == {"window_s": 0.05, "integration": "arc"}
    n_runs = sum(seed < 100 for seed, *_ in calls)
    assert n_runs <= 5 * 6 + 5  # at most one trial is begun twice


@pytest.mark.slow
def test_two_processes_that_are_killed_go_on_to_the_same_budget(tmp_path):
    pytest.importorskip("optuna")
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "toy.yaml").write_text(STUDY.format(trials=7, judged=1000, end=1002))
    results = tmp_path / "results"
    journal = results / "tune" / "toy" / "odometry.journal"
    command = [sys.executable, "-m", "experiments.cli", "tune", "toy", "--jobs", "2"]
    command += ["--config-dir", str(tmp_path)]
    environment = {**os.environ, "ESTIMA_RESULTS": str(results)}
    first = subprocess.Popen(command, env=environment, start_new_session=True)
    deadline = time.monotonic() + 120.0
    while not (journal.exists() and journal.read_bytes().count(b'"state":1') >= 2):
        assert first.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    before = journal.read_bytes()
    subprocess.run(command, env=environment, check=True, timeout=300)
    assert journal.read_bytes().startswith(before[: before.rfind(b"\n") + 1])
    trials = pd.read_csv(results / "tables" / "toy_trials_tuning.csv")
    assert list(trials["trial"]) == [*range(1, 8)]
    assert (results / "tuned" / "estimator" / "odometry_tuned.yaml").exists()


def test_the_tables_keep_what_was_not_tuned_now(tmp_path):
    path = tmp_path / "t.csv"
    names = {"a": {}, "b": {}, "c": {}}

    def write(estimators, value):
        table = pd.DataFrame({"estimator": estimators, "gain": value + 0.5})
        return tuning.merge_into(path, table, list(names))

    write(["c", "a"], 1.0)
    assert list(write(["b"], 2.0)["estimator"]) == ["a", "b", "c"]
    found = write(["a"], 3.0)
    assert list(found["gain"]) == [3.5, 2.5, 1.5]
    pd.testing.assert_frame_equal(pd.read_csv(path), found)


def test_no_two_estimators_are_drawn_alike():
    names = [f"method_{i}" for i in range(11)]
    trials = pd.DataFrame({"estimator": names, "trial": 1, "best_so_far_m": 0.1})
    gains = pd.DataFrame({"estimator": names, "tuned_over_default": 1.0, "low": 0.9, "high": 1.1})
    lines = tuning.curves(trials, gains).axes[0].lines
    assert len({(line.get_color(), line.get_marker()) for line in lines}) == len(names)
