"""Sweeps that run until they are decided: blocks, decisions, what is saved."""

import functools
import json
import math

import numpy as np
import pandas as pd
import pytest

from experiments.sweeps import launch, until
from experiments.sweeps.launch import sweep
from experiments.sweeps.plan import make_plan
from experiments.sweeps.until import DECIDED, Until, read_decided
from sim.errors import InputError
from tests.experiments.cli.test_cli import called, refused
from tests.experiments.sweeps.conftest import ALONE, SHORT, folder, table_of

ARMS = "estimator.window_s=0.1,0.2,0.3"


def plan_of(*more, arms=ARMS, seeds=60):
    return make_plan([*SHORT, "estimator=odometry", arms, f"seed=range(0,{seeds})", *more])


def rows_of(plan, runs, error):
    """Rows of some runs; the error is a function of the experiment, with noise of 10 %."""
    rows = []
    for i in runs:
        experiment = plan.experiment(i)
        noise = np.random.default_rng(i).normal(0.0, 0.1)
        rows.append(
            experiment.labels("")
            | {"repeat": 0, "run_key": experiment.key, "code_version": "v"}
            | {"recording_checksum": f"{plan.recordings[i]:x}", "status": "ok"}
            | {"ate_rmse_m": math.exp(noise) * error(experiment)}
        )
    return rows


def window_of(experiment):
    return experiment.labels("")["estimator.window_s"]


@pytest.fixture
def decided(tmp_path, monkeypatch):
    """Blocks that a sweep of fake rows takes, and what is written."""

    def run(plan, error, limits=None, fail=(), every=None):
        rows, blocks = [], []

        def read(_):
            if every is not None:
                return every
            table = pd.DataFrame(rows)
            failed = table["estimator.window_s"].isin(fail) & (table["seed"] == 3)
            return table.assign(status=table["status"].mask(failed, "failed"))

        monkeypatch.setattr(until, "read_runs", read)
        for block in (limits or Until()).blocks(plan, tmp_path):
            blocks.append(block)
            rows += rows_of(plan, block, error)
        return blocks, read_decided(tmp_path)

    return run


def test_the_best_is_decided_at_the_first_look_and_the_rest_is_saved(decided, capsys):
    plan = plan_of()
    blocks, found = decided(plan, lambda e: 2.0 if window_of(e) > 0.15 else 1.0)
    assert [len(block) for block in blocks] == [36]
    assert (found["made"], found["total"]) == (36, 180)
    assert {(c.arm, c.against, c.found) for c in found["comparisons"]} == {
        ("estimator.window_s=0.2", "estimator.window_s=0.1", "lost"),
        ("estimator.window_s=0.3", "estimator.window_s=0.1", "lost"),
    }
    said = capsys.readouterr()
    assert (
        "estimator.window_s=0.1 is the best\ndecided after 12 of 60 seeds; 144 of the 180 runs"
        in (said.out)
    )
    assert "12 of 60 seeds: estimator.window_s=0.2 loses to estimator.window_s=0.1 (2" in said.err


def test_an_arm_that_has_lost_is_dropped_and_close_ones_go_on(decided):
    plan = plan_of()
    errors = {0.1: 1.0, 0.2: 1.11, 0.3: 2.0}
    blocks, found = decided(plan, lambda e: errors[window_of(e)])
    assert len(blocks) > 1
    assert len(blocks[0]) == 36
    assert all(len(block) % 2 == 0 and len(block) < 36 for block in blocks[1:])  # two arms
    seeds = [plan.experiment(i).config["seed"] for block in blocks[1:] for i in block]
    assert min(seeds) == 12  # none again
    last = found["comparisons"][-1]
    assert (last.arm, last.found) == ("estimator.window_s=0.2", "lost")


def test_equal_arms_are_decided_by_the_margin(decided, capsys):
    plan = plan_of(arms="estimator.window_s=0.1,0.2")
    _, found = decided(plan, lambda _: 1.0, Until(margin=0.3))
    last = found["comparisons"][-1]
    assert (last.found, last.seeds < 60) == ("equal", True)
    assert "as good within the margin" in capsys.readouterr().out
    _, found = decided(plan, lambda _: 1.0, Until(margin=0.001))
    assert found["comparisons"][-1].seeds == 60  # the cap
    assert "not decided after 60 of 60 seeds; 0 of the 120 runs" in capsys.readouterr().out


def test_other_recordings_are_decided_apart(decided):
    plan = plan_of("robot.kr=1e-5,1e-3", arms="estimator.window_s=0.1,0.2")

    def error(experiment):
        return 1.0 if window_of(experiment) < 0.15 or experiment.robot().kr > 1e-4 else 2.0

    blocks, found = decided(plan, error, Until(margin=0.01))
    assert len(blocks[0]) == 48
    later = {plan.experiment(i).robot().kr for block in blocks[1:] for i in block}
    assert later == {1e-3}
    assert {c.over_recordings for c in found["comparisons"]} == {"robot.kr=1e-05", "robot.kr=0.001"}


def test_each_is_compared_with_those_named(decided, capsys):
    names = {"odometry": 2.0, "icp_odometry": 1.0, "ekf_icp": 1.9}
    sensors = ["sensors=lms291", "simulation.rays=exact", "seed=range(0,60)"]
    plan = make_plan([*SHORT, *sensors, f"estimator={','.join(names)}"])
    limits = Until(against=("odometry",), margin=0.02)
    blocks, found = decided(plan, lambda e: names[e.estimator_name], limits)
    assert {c.against for c in found["comparisons"]} == {"odometry"}
    states = {c.arm: c.found for c in found["comparisons"]}
    assert states["icp_odometry"] == "better"
    easy, hard = ([c for c in found["comparisons"] if c.arm == arm] for arm in [*names][1:])
    assert len(easy) < len(hard)
    assert {c.found for c in easy[:-1]} <= {"open"}  # a pair that is decided is left alone
    later = {plan.experiment(i).estimator_name for block in blocks[len(easy) :] for i in block}
    assert later == {"odometry", "ekf_icp"}
    assert "is the best" not in capsys.readouterr().out


def test_an_arm_of_which_runs_failed_is_left_out(decided):
    plan = plan_of()
    _, found = decided(plan, lambda e: 1.0 / window_of(e), fail=(0.3,))
    kinds = {c.arm: c.found for c in found["comparisons"]}
    assert kinds["estimator.window_s=0.3"] == "failed"
    assert kinds["estimator.window_s=0.1"] == "lost"  # to 0.2, the best that is whole


def test_decisions_follow_from_the_rows_whatever_else_is_there(decided):
    """A sweep that goes on, with all its rows there, takes the same blocks."""
    plan = plan_of()
    errors = {0.1: 1.0, 0.2: 1.11, 0.3: 2.0}
    first, found = decided(plan, lambda e: errors[window_of(e)])
    every = pd.DataFrame(rows_of(plan, range(len(plan.keys)), lambda e: errors[window_of(e)]))
    shuffled = every.sample(frac=1.0, random_state=0)
    again, same = decided(plan, lambda e: errors[window_of(e)], every=shuffled)
    assert [block.tolist() for block in again] == [block.tolist() for block in first]
    assert same == found


@pytest.mark.slow
def test_the_best_of_equal_arms_is_hardly_ever_dropped():
    """Five arms, none of which is better: each is dropped in at most 5 % of sweeps."""
    rng, wrong = np.random.default_rng(0), 0
    looks = until.plan_looks(60, until.FIRST_LOOK)
    interval = functools.partial(until.repeated_interval, looks=looks, spent=until.SPENT / 4)
    n_sweeps, names = 200, dict(enumerate("abcde"))
    for _ in range(n_sweeps):
        logs = pd.DataFrame(rng.normal(0.0, 0.3, size=(60, 5)))
        alive, lost = set(range(5)), set()
        for look in looks:
            table = until._Table(logs[:look], {"": range(5)}, names, names, set())
            found, alive = Until()._decide(table, alive, set(), interval)
            lost |= {c.arm for c in found if c.found == "lost"}
        wrong += "a" in lost  # as good as any
    assert wrong / n_sweeps < 0.05


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["until=decided", "seed=3"], "the seed is not swept"),
        (["until=soon", "seed=1,2"], "until=soon: give until=decided"),
        (["until=decided:", "seed=1,2"], "give until=decided"),
        (["until=decided:ate_rms", "seed=1,2"], "nearest: ate_rmse_m"),
        (["until=decided:nees_mean", "seed=1,2"], "not an error or time"),
        (["margin=0.1", "seed=1,2"], "goes with until=decided"),
        (["until=decided", "margin=0", "seed=1,2"], "margin=0: give a share"),
        (["until=decided", "seed=1,2"], "sweep several estimators"),
        (
            ["until=decided", "against=icp", ARMS, "seed=1,2"],
            "against=icp: the sweep has odometry",
        ),
    ],
)
def test_what_cannot_be_decided_is_said_before_anything_runs(arguments, complaint, monkeypatch):
    monkeypatch.setattr(launch, "_launch_all", None)
    with pytest.raises(InputError, match=complaint):
        sweep([*SHORT, "estimator=odometry", *arguments])


def test_a_damaged_record_is_named(tmp_path):
    assert read_decided(tmp_path) is None
    for text in ("{", "{}", json.dumps({"comparisons": [{"found": "won"}]})):
        (tmp_path / DECIDED).write_text(text)
        with pytest.raises(InputError, match="damaged"):
            read_decided(tmp_path)


def test_against_goes_with_a_sweep():
    done = called("run", "--against", "odometry")
    refused(done, "--against odometry: goes with -m and until=decided")


@pytest.mark.slow
def test_a_sweep_ends_when_it_is_decided_and_goes_on_where_it_was(name):
    """Real runs: the arm that believes another track errs more, and 8 seeds are saved."""
    route = [a.replace("linear_1", "angular_4") for a in ALONE]
    arguments = ["run", "-m", *route, "estimator=odometry",
                 "prior.track_m=0.19,0.3", "seed=range(0,20)", "until=decided:heading_rmse_rad",
                 f"name={name}"]  # fmt: skip
    done = called(*arguments)
    assert done.returncode == 0, done.stderr
    assert "at most 40 runs, 0 of them done before" in done.stderr
    assert "prior.track_m=0.19 is the best" in done.stdout
    assert (
        "decided after 12 of 20 seeds; 16 of the 40 runs of all seeds saved (40 %)" in done.stdout
    )
    assert len(table_of(name)) == 24
    before = (folder(name) / DECIDED).read_text()
    again = called(*arguments)
    assert "24 of them done before" in again.stderr
    assert (folder(name) / DECIDED).read_text() == before
    whole = called(*[a for a in arguments if not a.startswith("until")])  # adds what is missing
    assert whole.returncode == 0
    assert len(table_of(name)) == 40
