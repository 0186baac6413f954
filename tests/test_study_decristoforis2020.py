"""The studies of decristoforis2020 in small: every part runs, and its tables can be drawn."""

import numpy as np
import pandas as pd
import pytest

from experiments.papers.decristoforis2020 import study

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tables():
    seed = study.JUDGED_SEED
    methods = tuple(study.METHODS)
    parts = [
        study._office(seed, 15.0, 10.0, "exact", methods, True, True),
        study._office(seed + 1, 15.0, 10.0, "exact", methods, True, False),
        study._office(seed, 3.0, 75.0, "exact", ("icp", "fusion_clone"), False, False),
        study._closeup(seed, True),
        study._closeup(seed + 1, False),
        *(study._scenes(s, p, 4) for s in (seed, seed + 1) for p in study.PLACES),
        *(study._metrics(s, "room_small") for s in (seed, seed + 1)),
        *(study._ordering(s, 1e-6, 0.01) for s in (seed, seed + 1)),
    ]
    names = dict.fromkeys(name for part in parts for name in part)
    found = {
        name: pd.concat([p[name] for p in parts if name in p], ignore_index=True) for name in names
    }
    found["boxes"] = study._boxes(found.pop("errors"))
    return found


def test_errors_and_beliefs_are_sane(tables):
    runs = tables["runs"].set_index(["rate_hz", "seed", "method"])
    for seed in (study.JUDGED_SEED, study.JUDGED_SEED + 1):
        assert runs.loc[(10.0, seed, "fusion_clone"), "ate_rmse_m"] < 0.02
        assert runs.loc[(10.0, seed, "fusion"), "ate_rmse_m"] < 0.05
    assert (tables["beliefs"].groupby("belief").size() == 2).all()
    right = tables["beliefs"].query("belief == 'right'").set_index("seed")["ate_rmse_m"]
    clone = tables["runs"].query("method == 'fusion_clone' and rate_hz == 10.0")
    np.testing.assert_allclose(right, clone.set_index("seed")["ate_rmse_m"], rtol=1e-9)


def test_steps_know_their_bound(tables):
    steps = tables["steps"]
    assert (steps["correlation_lag_1"] < -0.2).all()
    assert (steps["step_error_rad"] > 0.5 * steps["step_bound_rad"]).all()
    assert (steps["accumulated_over_predicted_1s"] < 1.0).all()


def test_everything_can_be_judged_and_drawn(tables):
    claims = study.claims(tables, quick=True)
    assert {c.id for c in claims} == {"DC1", "DC2", "DC3", "DC4", "DC5", "DC6"}
    assert all(c.verdict.endswith("(quick)") for c in claims)
    pages = study.figures(tables)
    assert len(pages) == 10
    for page in pages.values():
        page.canvas.draw()
