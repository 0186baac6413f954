"""Scenes, and predicted covariances against the scatter of repeated registrations."""

import numpy as np
import pytest

from experiments.evaluation import registration_errors
from experiments.evaluation.registration_errors import measure, sample_scenes
from experiments.runs.experiment import Experiment
from sim import se2
from sim.sensors import Laser, Mount

LASER = Laser(sigma_range_m=0.01, mount=Mount(x_m=0.1))


@pytest.fixture(scope="module")
def world():
    return Experiment.compose(["world=corridor", "seed=3"]).world()


def test_scenes_lie_in_their_place(world):
    rng = np.random.default_rng(0)
    for place in ("corridor_bare", "curve", "corner"):
        for scene in sample_scenes(world, place, LASER.mount.pose, rng, 5):
            base = se2.compose(scene.T_w_target, se2.inverse(LASER.mount.pose))
            assert world.clearance_m(base) > 0.35
            near = base[:2] + np.array([[0, 0], [0.3, 0], [-0.3, 0], [0, 0.3], [0, -0.3]])
            assert place in world.place_of(near)
            moved = se2.between(scene.T_w_target, scene.T_w_source)
            assert np.hypot(moved[0], moved[1]) == pytest.approx(0.05, abs=0.01)


@pytest.mark.slow
def test_nees_distinguishes_a_fitting_covariance_from_a_wrong_one(world, monkeypatch):
    def table():
        rng = np.random.default_rng(4)
        (scene,) = sample_scenes(world, "corridor_objects", LASER.mount.pose, rng, 1)
        found = measure(scene, LASER, rng, 40, 3)
        return found[found["metric"] == "point_to_line"].set_index("method")

    found = table()
    assert 0.7 < found.loc["censi", "nees_over_dof"] < 1.4
    assert 0.8 < found.loc["censi", "determinant_ratio"] < 1.25
    assert found.loc["hessian", "nees_over_dof"] > 1.4
    # the target's noise, which fitted lines average away, is in the residuals of points
    lines, points = (found.loc[name, "nees_over_dof"] for name in ("hessian", "hessian_points"))
    assert lines / points == pytest.approx(2.0, rel=0.25)
    assert found.loc["sampling", "time_us"] > 10.0 * found.loc["censi", "time_us"]
    assert found.loc["censi", "bound_m"] < 1.5 * found.loc["censi", "error_m"]
    assert (found["used_share"] == 1.0).all()
    methods = registration_errors._methods
    monkeypatch.setattr(registration_errors, "_methods", lambda sigma, rng: methods(sigma / 2, rng))
    halved = table()
    ratio = halved.loc["censi", "nees_over_dof"] / found.loc["censi", "nees_over_dof"]
    assert ratio == pytest.approx(4.0, rel=1e-6)
