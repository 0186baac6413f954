"""Completion in the shell: what it offers, and that it is quick."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.cli import completion
from experiments.runs.experiment import Experiment

ROOT = Path(__file__).resolve().parents[3]
SLOW = {"numpy", "scipy", "pandas", "matplotlib", "hydra", "omegaconf", "numba"}  # to import


def asked(line, **environment):
    """The process that a shell starts at the end of a line, once it has ended."""
    code = "import sys; sys.argv = ['estima']\n"
    code += "from experiments.cli.main import app; app(prog_name='estima')"
    given = {
        "_ESTIMA_COMPLETE": "complete_fish",
        "_TYPER_COMPLETE_ARGS": line,
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
        "PYTHONPATH": str(ROOT),
        **environment,
    }
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, **given}
    )


def complete(line, **environment):
    """What a shell offers at the end of a line."""
    return asked(line, **environment).stdout.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("estima run world=o", {"world=office", "world=orchard"}),
        (
            "estima run world=office estimator=ekf_i",
            {"estimator=ekf_icp", "estimator=ekf_icp_paper", "estimator=ekf_icp_tuned"},
        ),
        ("estima options me", {"metrics"}),
        ("estima table sl", {"slip"}),
        ("estima plot slip --y nees_me", {"nees_mean", "nees_median"}),
        ("estima check --only fastslam_", {"fastslam_paper"}),
    ],
)
def test_the_shell_offers(tmp_path, line, offered):
    (tmp_path / "runs" / "slip").mkdir(parents=True)
    assert set(complete(line, ESTIMA_RESULTS=str(tmp_path))) == offered


def test_it_is_quick():
    done = asked("estima run estimator=mc", PYTHONPROFILEIMPORTTIME="1")
    assert done.stdout
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "typer" in imported
    assert not imported & SLOW


def test_every_key_that_is_offered_is_one():
    keys = [text[:-1] for text in completion.overrides("") if text[:-1] not in completion.GROUPS]
    assert {"seed", "prior.map", "simulation.physics", "prior.sigma_position_m"} <= set(keys)
    config = Experiment.compose().config
    for key in keys:
        place = config
        for name in key.split("."):
            assert name in place or key == "sweeps", key
            place = place.get(name)


def test_words_that_begin_otherwise_are_not_offered():
    assert completion.overrides("nothing_like_it") == []
    assert completion.overrides("seed=") == []
    assert completion.overrides("~world=off") == ["~world=office"]
    assert "route.speed_mps=" in completion.overrides("route.sp")
    assert "choice.estimator" in completion.settings("choice.")
    assert completion.suites("che") == ["check"]
