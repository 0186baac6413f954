"""The studies of decristoforis2020 in small: every part runs, and is judged and drawn from disk."""

import functools

import joblib
import pytest

from experiments.judging.results import Profile, Results
from experiments.papers.decristoforis2020 import claims, figures, study
from experiments.papers.decristoforis2020.settings import CHECKED, JUDGED_SEED, PAPERS_OWN, PLACES

pytestmark = pytest.mark.slow


def small(_full, out):
    """Jobs of every kind over two short drives."""
    short = functools.partial(study._planned, "methods", 2, "route.distance_m=6.0")
    slow = study._planned("methods", 1, "route.distance_m=6.0", "sensors.laser.rate_hz=10.0")
    (office,) = study._planned("methods", 1, "route.distance_m=300.0", "sensors.laser.rate_hz=2.0")
    beliefs = study._planned("beliefs", 2, "route.distance_m=6.0")
    corridors = study._planned("corridor", 2)
    adjusted = study.plan_experiments(
        ["study=decristoforis2020/tuning", "seed=60", "route.distance_m=3.0"]
    )
    adjusted = [run for run in adjusted if run.config["estimator"]["turn_noise"] == 2.0][:2]
    noise = ["robot.kr=1e-6", "sensors.laser.sigma_range_m=0.01", "route.distance_m=4.0"]
    seeds = (JUDGED_SEED, JUDGED_SEED + 1)
    return [
        (1.0, study._drawn_office, [study._only(PAPERS_OWN, office), out]),
        *((1.0, study._drive, [group]) for group in short()),
        (1.0, study._drive, [study._only(("icp", "fusion_clone"), slow[0])]),
        *((1.0, study._scored, ["beliefs", study._BELIEF, group]) for group in beliefs),
        (1.0, study._scored, ["process_noise", study._ADJUSTED, adjusted]),
        (1.0, study._closeup, [corridors[0], out]),
        (1.0, study._closeup, [corridors[1]]),
        *((1.0, study._scenes, [seed, place, 4]) for seed in seeds for place in PLACES),
        *((1.0, study._metrics, [seed, "room_small"]) for seed in seeds),
        *(
            (1.0, study._scored, ["ordering", study._NOISE, study._only(CHECKED, group)])
            for group in study._planned("ordering", 2, *noise)
        ),
    ]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    out, shares = Results(folder, "decristoforis2020"), []
    with pytest.MonkeyPatch.context() as patch, joblib.parallel_config("sequential"):
        patch.setenv("ESTIMA_RESULTS", str(folder))
        patch.setattr(study, "_jobs", small)
        study.run(Profile.QUICK, out, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    return out


def test_errors_and_beliefs_are_sane(made):
    runs, beliefs = made.table("runs"), made.table("beliefs")
    by_method = runs.set_index(["rate_hz", "seed", "method"])
    for seed in (JUDGED_SEED, JUDGED_SEED + 1):
        assert by_method.loc[(75.0, seed, "fusion_clone"), "ate_rmse_m"] < 0.02
        assert by_method.loc[(75.0, seed, "fusion"), "ate_rmse_m"] < 0.3
    assert (beliefs.groupby("belief").size() == 2).all()


def test_steps_know_their_bound(made):
    steps = made.table("steps")
    # of planes some -0.1 to 0.1; errors that drift together would come near 1
    assert steps["correlation_lag_1"].between(-0.6, 0.3).all()
    assert (steps["step_error_rad"] > 0.5 * steps["step_bound_rad"]).all()


def test_everything_can_be_judged_and_drawn(made):
    judged = claims.judge(made)
    assert {c.id for c in judged} == {"DC1", "DC2", "DC3", "DC4", "DC5", "DC6"}
    pages = figures.draw(made)
    assert len(pages) == 10
    for page in pages.values():
        page.canvas.draw()


def test_the_quick_profile_has_a_job_of_every_kind(tmp_path):
    quick = study._jobs(False, Results(tmp_path, "decristoforis2020"))
    kinds = {function for _, function, _ in quick} - {study._drawn_log}  # where the log is
    assert kinds == {function for _, function, _ in small(False, None)}
    drives = [arguments[0] for _, function, arguments in quick if function is study._drive]
    assert [len(group) for group in drives] == [5, 5, 5, 5, 4, 4]
