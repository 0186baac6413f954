"""The claim GI9: tables that pass and fail it, its sentence and figures."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from experiments.judging.claim import Role, Verdict, select_all
from experiments.judging.results import Results
from experiments.studies.teams import claims, figures, settings
from tests.fixtures.claims import concluded


def table_of(ratio, n_worlds=40, spread=0.3, seed=0, *, inside=0.95, narrower=0.7):
    """Errors in worlds where sightings change them by this factor."""
    rng, rows = np.random.default_rng(seed), []
    for world in range(n_worlds):
        for size in settings.SIZES:
            for name in claims.NAMES:
                error = np.exp(rng.normal(-2.0, 0.5))
                links = [*settings.LINKS] if (name, size) == ("ekf_slam", settings.LINKED) else []
                common = {"seed": world, "size": size, "filter": name}
                for sightings in (False, True):
                    factor = ratio * np.exp(rng.normal(0.0, spread)) if sightings else 1.0
                    for link in [settings.ALWAYS, *(links if sightings else [])]:
                        slower = 1.0 if link == settings.ALWAYS else 2.0
                        row = {"sightings": sightings, "link": link, "inside_share": inside}
                        row["sigma_m"] = 0.1 * (narrower if sightings else 1.0)
                        row["sigma_m"] *= np.exp(rng.normal(0.0, 0.05))
                        row["ate_rmse_m"] = error * factor * slower
                        rows.append(common | row)
    return pd.DataFrame(rows)


def headlines(table):
    return select_all(list(claims.gi9(table)), role=Role.HEADLINE)


def test_gi9_is_one_statistic_for_each_size_by_the_papers_method():
    found = headlines(table_of(0.5))
    assert len(found) == len(settings.SIZES)
    assert {claim.about.method for claim in found} == {settings.PRINTED}
    assert {claim.verdict for claim in found} == {Verdict.REPRODUCED}
    assert all(0.4 < claim.found.value < 0.6 for claim in found)


def test_gi9_can_fail():
    assert {claim.verdict for claim in headlines(table_of(2.0))} == {Verdict.NOT_REPRODUCED}
    assert Verdict.REPRODUCED not in {claim.verdict for claim in headlines(table_of(1.0))}
    assert Verdict.UNDECIDED in {claim.verdict for claim in headlines(table_of(0.9, 20))}
    mixed = table_of(0.5)
    worse = (mixed["size"] == 4) & (mixed["filter"] == settings.PRINTED) & mixed["sightings"]
    mixed.loc[worse, "ate_rmse_m"] *= 6.0
    assert concluded("teams", claims.gi9(mixed)).verdict is Verdict.NOT_REPRODUCED


def test_gi9_says_less_uncertain_only_of_calibrated_beliefs():
    def beliefs(**given):
        return select_all(list(claims.gi9(table_of(0.5, **given))), quantity="uncertainty")

    assert {claim.verdict for claim in beliefs()} == {Verdict.REPRODUCED}
    assert {claim.verdict for claim in beliefs(narrower=1.4)} == {Verdict.NOT_REPRODUCED}
    assert {claim.role for claim in beliefs()} == {Role.BESIDE}
    sure = beliefs(inside=0.3)
    assert {claim.verdict for claim in sure} == {Verdict.SHOWN}
    assert "30 % and 30 % of true positions" in sure[0].reason
    said = concluded("teams", claims.gi9(table_of(0.5, inside=0.3))).sentence
    assert "Uncertainty: not answerable for the printed filter, as it is overconfident" in said
    assert "its 95 % ellipses hold only 30 % and 30 % of the true positions" in said


def test_what_communication_costs():
    costs = select_all(list(claims.gi9(table_of(0.5))), quantity="communication")
    assert len(costs) == len(settings.LINKS)
    assert [c.found.value for c in costs] == pytest.approx([2.0] * len(costs))


def test_the_sentence_says_the_factors(tmp_path):
    made = Results(tmp_path, "teams")
    log = [
        {"robot": k, "arm": arm, "ate_rmse_m": 0.4 / (1 + i)}
        for k in range(5)
        for i, arm in enumerate(settings.MRCLAM_ARMS)
    ]
    made.write_tables(errors=table_of(0.5), mrclam=pd.DataFrame(log))
    assert concluded("teams", claims.judge(made)[:1]).sentence.startswith("Its definition")
    found = [*claims.gi9(made.table("errors")), *claims.on_the_log(made.table("mrclam"))]
    conclusion = concluded("teams", found)
    assert conclusion.verdict is Verdict.REPRODUCED
    assert "times that without them, in teams of 2 to 5 (it falls least" in conclusion.sentence
    assert "On MRCLAM 6, a real log, a team of five by EKF-SLAM has 0.333" in conclusion.sentence
    bare = [c for c in found if c.about.quantity != "MRCLAM 6"]
    assert "MRCLAM" not in concluded("teams", bare).sentence


def test_figures_draw(tmp_path):
    made = Results(tmp_path, "teams")
    made.write_tables(errors=table_of(0.5, n_worlds=6))
    square = np.array([[0.0, 0, 4, 0], [4, 0, 4, 4]])
    paths = {f"truth_{k}": np.cumsum(np.ones((5, 2)), axis=0) + k for k in range(3)}
    lines = {f"sightings_{k}": np.array([[0.0, 0, 1 + k, 2]]) for k in range(3)}
    heights = np.tile([0.0, 2.5], (2, 1))
    made.write_arrays("drive", walls=square, wall_z_m=heights, **paths, **lines)
    pages = figures.draw(made)
    assert set(pages) == {"teams_drive", "teams_errors", "teams_links"}
    for page in pages.values():
        page.savefig(tmp_path / "page.png")


def test_the_arms_of_a_filter_differ_in_sightings_alone():
    from experiments.studies.teams.study import _arms, compose_experiment

    for option in (*settings.FILTERS, "smoother"):
        arms = [arm for arm, labels in _arms(2, option) if labels["link"] == settings.ALWAYS]
        first, second = (dataclasses.asdict(compose_experiment(0, arm)) for arm in arms)
        assert first["config"]["estimator"].pop("robots") is None
        assert second["config"]["estimator"].pop("robots") == "robots"
        assert first == second
