"""The claim GI10: tables that pass and fail it, its sentence and figures."""

import numpy as np
import pandas as pd

from experiments.judging.claim import Role, Verdict, select
from experiments.judging.folders import findings
from experiments.judging.results import Results
from experiments.judging.sentences import conclude
from experiments.studies.exploration import claims, figures, settings


def table_of(area_gain=1.3, map_ratio=1.0, n_worlds=20, spread=0.05, seed=0):
    """Runs in which coordination changes the area and the map's error by these factors."""
    rng, rows = np.random.default_rng(seed), []
    for world in range(n_worlds):
        for strategy in settings.NAMES:
            better = strategy == settings.JUDGED
            area = 150.0 * (area_gain if better else 1.0) * np.exp(rng.normal(0.0, spread))
            error = 0.1 * (map_ratio if better else 1.0) * np.exp(rng.normal(0.0, spread))
            rows.append({"seed": world, "strategy": strategy, "area_m2": area,
                         "map_rmse_m": error, "stopped": int(world == 0)})  # fmt: skip
    return pd.DataFrame(rows)


def verdicts(table):
    return [claim.verdict for claim in claims.gi10(table) if claim.role is Role.HEADLINE]


def test_gi10_needs_more_area_and_a_map_that_is_no_worse():
    assert verdicts(table_of()) == [Verdict.REPRODUCED, Verdict.REPRODUCED]
    assert verdicts(table_of(area_gain=0.8))[0] is Verdict.NOT_REPRODUCED
    assert verdicts(table_of(area_gain=1.0))[0] is not Verdict.REPRODUCED
    assert verdicts(table_of(map_ratio=1.5))[1] is Verdict.NOT_REPRODUCED
    assert verdicts(table_of(spread=0.8))[1] is Verdict.UNDECIDED


def test_the_sentence_says_the_factors():
    found = [*claims.gi10(table_of(spread=1e-6))]
    [conclusion] = conclude(found, findings("exploration"))
    assert conclusion.verdict is Verdict.REPRODUCED
    assert "1.3] times the area" in conclusion.sentence
    assert "one building, shows what is claimed in 20 of 20 repetitions" in conclusion.sentence
    share = select(found, quantity="hit something", method=settings.JUDGED)
    assert share.found.value == 1.0 / (settings.N_ROBOTS * 20)


def test_figures_draw(tmp_path):
    made = Results(tmp_path, "exploration")
    at = np.arange(0.0, 16.0, 0.5)
    curves = [
        pd.DataFrame({"seed": world, "strategy": name, "driven_m": at, "area_m2": 10.0 * at + k})
        for k, name in enumerate(settings.NAMES)
        for world in range(3)
    ]
    made.write_tables(coverage=pd.concat(curves))
    square = np.array([[0.0, 0, 4, 0], [4, 0, 4, 4]])
    paths = {f"truth_{k}": np.cumsum(np.ones((5, 2)), axis=0) + k for k in range(3)}
    for name in (settings.BASE, settings.BOTH):
        heights = np.tile([0.0, 2.5], (2, 1))
        made.write_arrays(f"drive_{name}", walls=square, wall_z_m=heights, **paths)
    pages = figures.draw(made)
    assert set(pages) == {"exploration_drive", "exploration_coverage"}
    for page in pages.values():
        page.savefig(tmp_path / "page.png")
