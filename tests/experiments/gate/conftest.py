"""A small suite for the tests of the gate, and rows of one."""

from functools import partial

import numpy as np
import pandas as pd
import pytest

from experiments.gate import baseline
from experiments.gate.suite import (
    ERRORS,
    run_suite,
)

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


def of_recordings(rng, n=100):
    return np.exp(rng.standard_normal((n, 1)))


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


def no_run(*_, **__):
    raise AssertionError("ran")
