"""The studies of decristoforis2020 in small: every part runs, and is judged and drawn from disk."""

import joblib
import pytest

from experiments.judging import sequential
from experiments.judging.claim import WAITS
from experiments.judging.results import Profile, Results
from experiments.papers.decristoforis2020 import claims, figures, study
from experiments.papers.decristoforis2020.settings import PAPERS_OWN, PLACES

SEEDS = (0, 1)

pytestmark = pytest.mark.slow


def small(_profile, out):
    """Jobs of every kind, on short drives."""
    (slow,) = study._planned("methods", [0], "route.distance_m=6.0", "sensors.laser.rate_hz=10.0")
    (office,) = study._planned(
        "methods", [0], "route.distance_m=300.0", "sensors.laser.rate_hz=2.0"
    )
    beliefs = study._planned("beliefs", SEEDS, "route.distance_m=6.0")
    (corridor,) = study._planned("corridor", [0])
    adjusted = study.plan_experiments(
        ["study=decristoforis2020/tuning", "seed=60", "route.distance_m=3.0"]
    )
    adjusted = [run for run in adjusted if run.config["estimator"]["turn_noise"] == 2.0][:2]
    return [
        (1.0, study._drawn_office, [study._only(PAPERS_OWN, office), out]),
        (1.0, study._drive, [study._only(("icp", "fusion_clone"), slow)]),
        *((1.0, study._scored, ["beliefs", study._BELIEF, group]) for group in beliefs),
        (1.0, study._scored, ["process_noise", study._ADJUSTED, adjusted]),
        (1.0, study._drawn_corridor, [corridor, out]),
        *((1.0, study.covariances_of, [seed, place, 4]) for seed in SEEDS for place in PLACES),
    ]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    out, shares = Results(folder, "decristoforis2020"), []
    with pytest.MonkeyPatch.context() as patch, joblib.parallel_config("sequential"):
        patch.setenv("ESTIMA_RESULTS", str(folder))
        patch.setattr(study, "_jobs", small)
        patch.setattr(study, "region_jobs", lambda *_: [])
        patch.setattr(sequential, "N_QUICK", len(SEEDS))
        study.run(Profile.QUICK, out, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    return out


def test_errors_and_beliefs_are_sane(made):
    runs, beliefs = made.table("runs"), made.table("beliefs")
    by_method = runs.set_index(["rate_hz", "seed", "method"])
    for seed in SEEDS:
        assert by_method.loc[(18.75, seed, "fusion_clone"), "ate_rmse_m"] < 0.02
        assert by_method.loc[(18.75, seed, "fusion"), "ate_rmse_m"] < 0.3
    assert (beliefs.groupby("belief").size() == 2).all()


def test_steps_know_their_bound(made):
    steps = made.table("steps")
    # of planes some -0.1 to 0.1; errors that drift together would come near 1
    assert steps["correlation_lag_1"].between(-0.6, 0.3).all()
    assert (steps["step_error_rad"] > 0.5 * steps["step_bound_rad"]).all()


def test_everything_can_be_judged_and_drawn(made):
    judged = claims.judge(made)
    assert {c.id for c in judged} == {"DC1", "DC2", "DC3", "DC4", "DC5", "DC6"}
    assert {c.about.quantity for c in judged} == {WAITS}  # for the runs over their regions
    runs = made.table("runs")
    assert {c.verdict for c in claims.dc1(runs)} <= {"undecided", "shown"}  # of two worlds
    assert len(claims.dc6(runs)) > 5
    pages = figures.draw(made)
    assert len(pages) == 9
    for page in pages.values():
        page.canvas.draw()


def test_the_quick_profile_has_a_job_of_every_kind(tmp_path):
    quick = study._jobs(Profile.QUICK, Results(tmp_path, "decristoforis2020"))
    kinds = {function for _, function, _ in quick} - {study._drawn_log}  # where the log is
    assert kinds == {function for _, function, _ in small(False, None)}
    drives = [arguments[0] for _, function, arguments in quick if function is study._drive]
    assert [len(group) for group in drives] == [4, 4]
