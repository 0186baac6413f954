"""Plans of sweeps: what is expanded, composed, named and packed, and what is refused."""

import numpy as np
import pytest

from experiments.runs.compose import searched
from experiments.runs.console import RunFailedError
from experiments.runs.experiment import Experiment
from experiments.runs.paths import quoted, results
from experiments.sweeps import launch, plan
from sim.errors import InputError
from tests.experiments.cli.test_cli import QUICK, called, refused
from tests.experiments.sweeps.conftest import SHORT


def test_the_last_values_of_a_key_are_swept():
    found = plan.parse_swept(["seed=range(0,3)", "robot.kr=1e-5,1e-4", "seed=7,8", "a=b"])
    assert found == {"seed": [7, 8], "robot.kr": [1e-5, 1e-4], "a": ["a=b"]}
    assert plan.parse_swept(["seed=range(0,1000000)"])["seed"] == range(1000000)
    with pytest.raises(InputError, match=r"interval.*lists and ranges"):
        plan.parse_swept(["robot.kr=interval(0,1)"])


def test_a_million_runs_are_planned_as_each_of_them_alone():
    kinematic = "simulation.physics=kinematic"
    slips = ["robot.kr=range(1,101,0.1)", "robot.kl=${robot.kr}"]
    every = plan.make_plan(["seed=range(0,1000)", *slips, kinematic])
    assert len(every.keys) == len(np.unique(every.keys)) == 10**6
    assert len(every.families) == 1
    for i in (0, 1, 500_123, 999_999):
        run = every.experiment(i)
        c = run.config
        alone = Experiment.compose(
            [f"seed={i // 1000}", f"robot.kr={c['robot']['kr']}", "robot.kl=${robot.kr}",
             "simulation.physics=kinematic"]
        )  # fmt: skip
        assert c == alone.with_values(picture=False).config
        assert int(alone.key, 16) == every.keys[i]


def test_keys_of_a_plan_are_those_of_its_runs(tmp_path):
    given = ["estimator=ekf_icp,ekf_icp_paper", "seed=2,1", "simulation.physics=kinematic,bullet",
             "sensors=lms291", "prior.track_m=null,0.2", "world.n_objects=3,6",
             "estimator.kr=1e-5,1e-4"]  # fmt: skip
    every = plan.make_plan(given)
    assert len(every.keys) == len(np.unique(every.keys)) == 64
    recordings = {}
    for i, key in enumerate(every.keys):
        run = every.experiment(i)
        assert int(run.key, 16) == key
        recordings.setdefault(run.recording_key, set()).add(every.recordings[i])
    assert len(recordings) == 8
    assert all(len(same) == 1 for same in recordings.values())
    assert [every.experiment(i).seed for i in range(0, 64, 16)] == [2, 1, 2, 1]


def test_the_quick_composer_resolves_as_hydra_does():
    given = ["world=office", "estimator=ekf_icp,odometry", "sensors=lms291", "robot.kr=1e-6,2e-6"]
    study = ["estimator.window_s=0.1", "study=decristoforis2020/office", "seed=3,4"]
    runs = list(plan.plan_experiments([*given, *study]))
    assert len(runs) == 2 * 2 * 2
    for run in runs:
        c = run.config
        lines = [
            "study=decristoforis2020/office", "world=office", "sensors=lms291",
            f"estimator={run.choices['estimator']}", f"robot.kr={c['robot']['kr']}",
            f"seed={c['seed']}", "estimator.window_s=0.1", "picture=false",
        ]  # fmt: skip
        assert c == Experiment.compose(lines).config
        assert c["estimator"]["kr"] == c["robot"]["kr"]  # belief follows truth after the change
    assert len({run.key for run in runs}) == 8


def test_a_study_sweeps_its_own_values_unless_others_are_given():
    runs = list(plan.plan_experiments(["study=decristoforis2020/office"]))
    assert len(runs) == 20 * 4
    assert {run.config["seed"] for run in runs} == set(range(1000, 1020))
    runs = list(
        plan.plan_experiments(["study=decristoforis2020/office", "seed=1", "estimator=odometry"])
    )
    assert [run.config["seed"] for run in runs] == [1]


def test_unknown_keys_and_options_are_refused():
    with pytest.raises(InputError, match=r"robot\.krr"):
        list(plan.plan_experiments(["robot.krr=1,2"]))
    refused(called("run", "-m", "robot.krr=1,2"), "robot.krr")
    refused(called("run", "-m", "world=nowhere,room"), "nowhere")
    refused(called("run", "-m", "--frob", "seed=1,2"), "--frob")


def test_keys_depend_on_the_settings():
    experiment = Experiment.compose([])
    assert experiment.with_values(name="other").key == experiment.key
    assert experiment.with_values(seed=5).key != experiment.key
    with pytest.raises(InputError, match=r"nowhere\.npz"):
        _ = experiment.with_values(recording="nowhere.npz").recording_key


def test_packing_keeps_recordings_together():
    every = plan.make_plan(["repeats=1,2", "seed=range(0,6)"])
    jobs = plan.pack_jobs(every.recordings, 3)
    assert sorted(np.concatenate(jobs)) == list(range(12))
    assert len(jobs) == 3
    for job in jobs:
        assert len({every.experiment(i).seed for i in job}) == 2
    assert max(len(job) for job in plan.pack_jobs(every.recordings, 100)) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["name=a,b", "seed=0"], "one, not several"),
        (["name=2026", "seed=0,1"], "one word"),
        (["name=../../evil", "seed=0,1"], "one word"),
        (["name=null", "seed=0,1"], "one word"),
        (["seed=range(5,0)"], "seed=range(5,0): no value"),
        (["study=maximo2024/own", "seed=0,1"], "data"),
    ],
)
def test_wrong_sweeps_end_in_one_line(arguments, words):
    refused(called("run", "-m", *SHORT[:2], *arguments), words)
    for never in ("runs/b", "runs/2026", "runs/None", "../evil"):
        assert not (results() / never).exists()


def test_the_last_value_of_a_key_decides_a_sweeps_own_name():
    made = plan.make_plan(["seed=0,1"])
    orders = (["robot.kr=1e-5", "robot.kr=1e-4"], ["robot.kr=1e-4", "robot.kr=1e-5"])
    forward, back = (made.name_by(["seed=0,1", *order], None) for order in orders)
    assert forward != back
    assert forward == made.name_by(["robot.kr=1e-4", "seed=0,1"], None)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-m", "hydra/sweeper=optuna"], ["hydra/sweeper", "every combination"]),
        (["-m", "hydra.sweep.dir=/tmp/x"], ["hydra.sweep.dir", "set name"]),
        (["hydra.run.dir=/tmp/x"], ["hydra.run.dir", "ESTIMA_RESULTS"]),
        (["hydra.verbose=true"], ["hydra.verbose", "nothing is logged"]),
        (["-m", "robot.kr=interval(0,1)"], ["interval(0,1)", "range(0,1,0.1)"]),
        (["-m", "route=glob(nothing*)"], ["route=glob(nothing*): no value"]),
        (["-m", "--info"], ["--info", "--config-dir"]),
        (["-m", "--cfg", "job"], ["one configuration", "leave out the lists"]),
    ],
)
def test_what_hydra_would_ignore_is_refused(arguments, words):
    refused(called("run", *arguments, *QUICK, "seed=0"), *words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["seed=range(0,1000000000000)"], "range.0,1000000000000.: .* at most 100,000,000 runs"),
        (["robot.kr=range(0,1e12,0.1)"], "at most 100,000,000 runs"),
        (["robot.kr=range(0,inf,0.1)"], "at most 100,000,000 runs"),
        (["seed=range(0,20000)", "robot.kr=range(0,10000)"], "2e[+]08 runs: a sweep has at most"),
        (["seed=range(0,5,0)"], "step of a range must not be 0"),
        (["seed=1,2", "hydra.searchpath=[file:///nope]"], "no folder /nope"),
    ],
)
def test_what_cannot_be_planned_is_refused_before_it_is_listed(arguments, words):
    with pytest.raises(InputError, match=words):
        plan.make_plan(arguments)


@pytest.mark.parametrize("sweeps", ["3", "[3]", "[[seed]]"])
def test_the_sweeps_of_a_study_are_a_list_of_mappings(tmp_path, sweeps):
    option(tmp_path, f"sweeps: {sweeps}")
    with pytest.raises(InputError, match="sweeps must be a list of mappings"):
        plan.make_plan(["study=own", "seed=0,1"], str(tmp_path))


@pytest.mark.parametrize(
    ("text", "is_read"),
    [
        ("hydra: {sweeper: {params: {seed: '1,2'}}}", True),
        ("hydra: {sweep: {dir: zzz}, verbose: true}", False),
        ("hydra: {sweeper: {max_batch_size: 1}}", False),
        ("hydra: {launcher: {n_jobs: 1}}", False),
        ("hydra: 3", False),
        ("hydra: {sweeper: 3}", False),
        ("defaults: [{override /hydra/launcher: basic}]", False),
    ],
)
def test_a_studys_settings_of_hydra_that_nothing_reads_are_refused(tmp_path, text, is_read):
    option(tmp_path, text)
    if is_read:
        assert len(plan.make_plan(["study=own"], str(tmp_path)).keys) == 2
        return
    with pytest.raises(InputError, match=r"own\.yaml: .*hydra\.sweeper\.params alone"):
        searched(tmp_path)


def option(folder_, text):
    (folder_ / "study").mkdir()
    (folder_ / "study" / "own.yaml").write_text(f"# @package _global_\n{text}\n")


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("hydra.launcher.n_jobs=0", "or -1 for all"),
        ("hydra.launcher.n_jobs=999999999", "or -1 for all"),
        ("+hydra.sweeper.params={}", "seed=1,2"),
    ],
)
def test_a_sweeps_wrong_settings_of_hydra(argument, words):
    with pytest.raises(InputError, match=words):
        launch.sweep(["seed=1,2", argument])


def test_globs_choose_options():
    runs = list(plan.plan_experiments(["route=glob(linear_*)", "simulation.physics=kinematic"]))
    assert [run.choices["route"] for run in runs] == [f"linear_{i}" for i in range(1, 5)]


@pytest.mark.parametrize(
    "name", ["a\\'b", "q${seed}x", "a\\${x}\\", "\\\\${x}'", "a b,c=[d]{e}", "ä$"]
)
def test_any_path_can_be_a_value(name):
    experiment = Experiment.compose([f"recording={quoted(name)}"])
    assert experiment.config["recording"] == name


def test_a_missing_value_can_be_given_in_a_sweep(tmp_path):
    runs = list(plan.plan_experiments(["study=maximo2024/own", f"data={tmp_path}", "seed=0,1"]))
    assert len(runs) == 2
    assert runs[0].config["recording"]["positions"] == f"{tmp_path}/positions.npy"


def test_the_number_of_jobs():
    runs = plan.make_plan([*QUICK, "seed=range(0,40)"])
    assert len(plan.pack_jobs(runs.recordings, launch._n_jobs(["jobs=20"]))) == 20
    assert launch._n_jobs([]) == launch._n_jobs(["jobs=null"]) > 0
    for wrong in (["jobs=0"], ["jobs=many"], ["jobs=1", "jobs=2"]):
        with pytest.raises(InputError, match="one whole number"):
            launch._n_jobs(wrong)


def test_workers_that_die_before_a_run_are_started_once_more(tmp_path, monkeypatch):
    tried = []

    def dies(*_):
        tried.append(1)
        return RuntimeError("terminated")

    monkeypatch.setattr(launch, "_launch", dies)
    every = plan.make_plan([*QUICK, "seed=0,1"])
    with pytest.raises(RunFailedError, match="died twice before its first run"):
        launch._launch_all(every, np.arange(2), launch.Jobs(tmp_path, 1), [])
    assert len(tried) == 2
    assert not list(tmp_path.glob("plan-*"))
