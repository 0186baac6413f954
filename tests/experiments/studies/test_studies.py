"""Every study of conf/study composes, fits together, and runs, at the least size."""

import numpy as np
import pytest

from experiments.judging.logs import why_missing
from experiments.runs.evaluate import evaluate
from experiments.runs.paths import option_names
from experiments.runs.row import Outcome
from experiments.sweeps.plan import plan_experiments
from tests.fixtures.fakes import peers_may_be_missing

STUDIES = option_names("study")


def shortened(experiment):
    """The experiment on a few metres, with few particles."""
    route, estimator = dict(experiment.config["route"]), dict(experiment.config["estimator"])
    if "distance_m" in route:
        route["distance_m"] = 4.0
    for key, most in (("n_particles", 20), ("max_particles", 300), ("min_particles", 100)):
        if key in estimator:
            estimator[key] = min(estimator[key], most)
    return experiment.with_values(route=route, estimator=estimator, repeats=1)


def runs_of(name, folder):
    """One run of a study for each of its estimators."""
    given = {
        "maximo2024/own": f"data={own_places(folder)}",
        "maximo2024/network": "network._target_=tests.fixtures.fakes.outline",
    }
    runs = list(plan_experiments([f"study={name}", *([given[name]] if name in given else [])]))
    return list({run.estimator_name: run for run in reversed(runs)}.values())


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            n,
            marks=[pytest.mark.slow] * (n in ("all_estimators", "boards", "leaderboard", "peers")),
        )
        for n in STUDIES
    ],
)
def test_each_study_fits_together(name, tmp_path):
    for experiment in runs_of(name, tmp_path):
        with peers_may_be_missing():
            experiment.check()


@pytest.mark.slow
@pytest.mark.parametrize("name", STUDIES)
def test_each_study_runs(name, tmp_path):
    if name == "decristoforis2020/rawseeds":
        pytest.skip("needs a log of Rawseeds")
    if name.startswith(("real_logs", "decristoforis2020/log")) and (why := why_missing()):
        pytest.skip(why)
    for experiment in runs_of(name, tmp_path):
        with peers_may_be_missing():
            rows = evaluate(shortened(experiment))
        assert [row["status_detail"] for row in rows if row["status"] == Outcome.FAILED] == []


def own_places(folder):
    """Files of positions and descriptors along a line."""
    rng = np.random.default_rng(0)
    line = np.column_stack([np.arange(30.0), np.zeros(30)])
    unit = rng.standard_normal((30, 64))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    for prefix in ("map_", ""):
        np.save(folder / f"{prefix}positions.npy", line)
        np.save(folder / f"{prefix}descriptors.npy", unit)
    return folder
