"""FastSLAM as a whole."""

import dataclasses

import numpy as np
import pytest

from estimators.base import run
from estimators.landmarks import fastslam
from estimators.landmarks.fastslam import FastSLAM
from estimators.odometry import Odometry
from experiments.evaluation.metrics import position_errors_m, rms, score
from experiments.gate.conform import check_estimator
from sim.errors import InputError
from sim.recording import Frame
from tests.fixtures.fakes import (
    circle,
    tracking_prior,
    true_ids,
    with_descriptors,
    with_field,
    with_reading,
)

K = {"kr": 1e-3, "kl": 1e-3}  # wheels so poor that the camera has something to mend


@pytest.fixture(scope="module")
def recording():
    return circle(seed=1, n_frames=160, **K)


def walked(recording, seed=0, keep=(), prior=None, **options):
    estimator = FastSLAM(**{**K, "n_particles": 60, **options})
    prior = prior or tracking_prior(recording, (1e-3, 1e-3, 1e-3), with_map=False)
    done = run(estimator, recording, prior, np.random.default_rng(seed), keep)
    return done, estimator


def error_m(recording, estimate):
    return rms(position_errors_m(recording.truth_at(estimate.stamps), estimate.means))


def test_the_gate_leaves_misread_ids_out(recording):
    rng = np.random.default_rng(0)
    ids = recording.log("stereo")["ids"].copy()
    wrong = rng.random(len(ids)) < 0.02
    ids[wrong] = rng.integers(len(recording.truth.world.landmarks), size=int(wrong.sum()))
    misread = with_field(recording, "stereo", ids=ids)
    off = {
        gate: error_m(misread, walked(misread, gate_probability=gate)[0]) for gate in (None, 1e-6)
    }
    assert off[1e-6] < 0.2
    assert off[None] > 2.0 * off[1e-6]


def test_slip_in_bursts_is_followed():
    """A wheel that jumps by far more than is believed leaves a normal cloud behind."""
    sound = circle(seed=2, n_frames=120, kr=1e-5, kl=1e-5)
    position = sound.wheels.position_m.copy()
    for row in (40, 80):
        position[row:, 0] += 0.06
    jumped = dataclasses.replace(
        sound, wheels=dataclasses.replace(sound.wheels, position_m=position)
    )
    off = {}
    for dof in (None, 2.0):
        done = [
            walked(jumped, seed, kr=1e-4, kl=1e-4, slip_dof=dof, proposal="motion")[0]
            for seed in range(3)
        ]
        off[dof] = np.mean([error_m(jumped, d) for d in done])
    assert off[2.0] < 0.8 * off[None]


@pytest.mark.parametrize("proposal", ["motion", "optimal"])
def test_mends_what_the_wheels_spoil(recording, proposal):
    done, estimator = walked(recording, proposal=proposal, keep=("ess", "resampled"))
    prior = tracking_prior(recording, (1e-3, 1e-3, 1e-3))
    blind = run(Odometry(**K), recording, prior, np.random.default_rng(0))
    revised = estimator.finish()
    assert error_m(recording, done) < 0.3 * error_m(recording, blind)
    assert error_m(recording, revised) < 0.3 * error_m(recording, blind)
    assert done.status == "ok"
    assert (done.kind, revised.kind) == ("online", "revised")
    assert np.array_equal(revised.stamps, recording.frame_stamps)
    found = estimator.map
    off = np.linalg.norm(found["landmarks"] - recording.truth.world.landmarks[found["ids"]], axis=1)
    assert np.median(off) < 0.1
    assert np.all(np.array(done.extras["ess"]) <= 60.0 + 1e-9)
    assert 0.0 < np.mean(done.extras["resampled"]) < 1.0


def test_the_optimal_proposal_wastes_fewer_particles(recording):
    ess = {
        proposal: np.mean(
            walked(recording, proposal=proposal, keep=("ess",), ess_share=1.0)[0].extras["ess"]
        )
        for proposal in ("motion", "optimal")
    }
    assert ess["optimal"] > 1.3 * ess["motion"]


def test_both_proposals_have_the_same_posterior():
    """Without resampling, few particles of 2.0 agree with 1e5 of 1.0: weights are right."""
    recording = circle(seed=3, n_frames=7, rate_hz=2.0, kr=5e-5, kl=5e-5)
    log = recording.log("stereo")
    kept = np.isin(log["ids"], np.unique(log["ids"])[:6])
    splits = np.concatenate([[0], np.cumsum(kept)])[log.splits]
    left = {name: values[kept] for name, values in log.values.items()}
    recording = with_field(recording, "stereo", splits, **left)
    believed = {"kr": 5e-5, "kl": 5e-5, "ess_share": 0.0}
    believed |= {"sigma_column_px": 12.0, "sigma_row_px": 12.0, "sigma_disparity_px": 3.0}
    many, _ = walked(recording, n_particles=100_000, proposal="motion", keep=("ess",), **believed)
    few, _ = walked(recording, n_particles=4_000, proposal="optimal", keep=("ess",), **believed)
    sigma = np.sqrt(np.diagonal(many.covariances[-1]))
    assert many.extras["ess"][-1] > 400
    assert few.extras["ess"][-1] > 1000
    assert np.all(np.abs(few.means[-1] - many.means[-1]) < 0.2 * sigma)
    assert np.allclose(np.sqrt(np.diagonal(few.covariances[-1])), sigma, rtol=0.2)


def test_errors_of_both_answers_are_within_their_covariances():
    """Of starts in doubt, over drives long enough to leave few ancestors of the start."""
    scores = {"online": [], "revised": []}
    for seed in range(12):
        recording = circle(seed, n_frames=160, kr=1e-4, kl=1e-4, start=(8.0, 6.0, 0.4))
        prior, rng = tracking_prior(recording, (0.05, 0.05, 0.05)), np.random.default_rng([seed, 1])
        start = rng.multivariate_normal(prior.mean, prior.covariance)
        estimator = FastSLAM(kr=1e-4, kl=1e-4, n_particles=50)
        online = run(estimator, recording, dataclasses.replace(prior, mean=start), rng)
        for answer in (online, estimator.finish()):
            known = score(recording, answer)
            scores[answer.kind].append([known["inside_95_share"], known["nees_mean"]])
    for kind in scores:
        inside, squares = np.mean(scores[kind], axis=0)
        assert inside > 0.85, kind
        assert 1.0 < squares < 4.5, kind


@pytest.mark.parametrize(("start", "spread_rad"), [("apart", 0.0), ("drawn", 0.05)])
def test_the_start_is_added_or_drawn(start, spread_rad):
    recording = circle(seed=0, n_frames=2)
    prior = tracking_prior(recording, (0.05, 0.05, 0.05))
    estimator = FastSLAM(n_particles=2000, start=start)
    online = run(estimator, recording, prior, np.random.default_rng(0), ("particles",))
    assert online.extras["particles"][0][:, 2].std() == pytest.approx(spread_rad, rel=0.05)
    assert np.sqrt(online.covariances[0, 2, 2]) == pytest.approx(0.05, rel=0.05)


def test_shared_and_contiguous_maps_give_the_same_bits(recording):
    for options in (
        {"proposal": "motion", "resampling": "multinomial", "ess_share": 1.0},
        {"association": "mahalanobis", "ess_share": 0.9},
    ):
        first, a = walked(recording, maps="shared", **options)
        second, b = walked(recording, maps="contiguous", **options)
        assert np.array_equal(first.means, second.means)
        assert np.array_equal(a.finish().means, b.finish().means)
        for key in ("landmarks", "landmark_covariances", "origins"):
            assert np.array_equal(a.map[key], b.map[key])


@pytest.mark.parametrize("proposal", ["motion", "optimal"])
def test_associates_without_ids(proposal):
    believed = {"kr": 1e-4, "kl": 1e-4}
    recording = circle(seed=2, n_frames=160, identifies=False, **believed)
    options = {"association": "mahalanobis", "proposal": proposal, "keep": ("associations",)}
    done, estimator = walked(recording, **options, **believed)
    told, guessed = (
        true_ids(recording),
        np.concatenate([a for a in done.extras["associations"] if a is not None]),
    )
    assert np.mean(told[guessed] == told) > 0.9
    again = guessed != np.arange(len(guessed))
    assert np.mean(again) > 0.7
    assert len(estimator.map["landmarks"]) < 2.0 * len(np.unique(told))
    assert "ids" not in estimator.map


def test_known_association_tells_where_each_landmark_began(recording):
    done, estimator = walked(recording, keep=("associations",))
    ids = recording.log("stereo")["ids"]
    _, first = np.unique(ids, return_index=True)
    began = {ids[i]: i for i in first}
    told = np.concatenate([a for a in done.extras["associations"] if a is not None])
    assert told.tolist() == [began[i] for i in ids]
    assert estimator.map["origins"].tolist() == [began[i] for i in estimator.map["ids"]]


def described(recording, words_of_observations, sigma=0.3):
    """The recording with noisy descriptors: words (K, 64) of its observations."""
    rng = np.random.default_rng(0)
    seen = words_of_observations + sigma * rng.standard_normal(words_of_observations.shape)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    return with_descriptors(recording, seen)


def test_descriptors_decide_with_the_distance():
    believed = {"kr": 1e-4, "kl": 1e-4}
    recording = circle(seed=2, n_frames=100, identifies=False, **believed)
    told, rng = true_ids(recording), np.random.default_rng(0)
    words = rng.standard_normal((len(recording.truth.world.landmarks), 64))
    arms = {
        "each its own": words[told],
        "all alike": np.tile(words[0], (len(told), 1)),
        "never the same": rng.standard_normal((len(told), 64)),
    }
    again = {}
    for name, seen in arms.items():
        done, _ = walked(
            described(recording, seen),
            keep=("associations",),
            association="descriptor",
            sigma_descriptor=0.3,
            **believed,
        )
        guessed = np.concatenate([a for a in done.extras["associations"] if a is not None])
        again[name] = np.mean(guessed != np.arange(len(guessed)))
        if name == "each its own":
            assert np.mean(told[guessed] == told) > 0.99
    assert again["each its own"] > 0.7
    assert again["all alike"] > 0.7
    assert again["never the same"] < 0.02


def test_says_what_is_missing(recording):
    nameless = circle(n_frames=4, identifies=False)
    with pytest.raises(InputError, match="does not identify"):
        walked(nameless)
    with pytest.raises(InputError, match="without descriptors"):
        walked(nameless, association="descriptor")
    prior = dataclasses.replace(tracking_prior(recording), mean=None, covariance=None)
    with pytest.raises(InputError, match="start pose"):
        walked(recording, prior=prior)


@pytest.mark.parametrize(
    "wrong",
    [
        {"n_particles": 0},
        {"n_particles": 10**12},
        {"n_particles": 2.5},
        {"proposal": "bootstrap"},
        {"resampling": "none"},
        {"association": "guess"},
        {"maps": "tree"},
        {"noise_model": "pixel"},
        {"ess_share": -1.0},
        {"p0": 0.0},
        {"kr": float("nan")},
        {"sigma_row_px": -1.0},
    ],
)
def test_wrong_options_are_told(wrong):
    with pytest.raises(InputError, match=f"estimator.{next(iter(wrong))}"):
        FastSLAM(**wrong)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"proposal": "motion", "resampling": "residual", "noise_model": "correlated"},
        {"resampling": "stratified", "noise_at": "measured", "noise_model": "diagonal"},
        {"association": "mahalanobis", "n_particles": 17},
        {"n_particles": 1},
    ],
)
def test_conforms(recording, options):
    prior = tracking_prior(recording)
    make = lambda: FastSLAM(**{**K, "n_particles": 40, **options})  # noqa: E731
    for result in check_estimator(make, recording, prior, n_frames=40):
        assert result.passed, f"{result.name}: {result.message}"


# What may go wrong in an image


def seen(points, ids=None):
    points = np.array(points, float).reshape(-1, 3)
    known = {} if ids is None else {"ids": np.array(ids, np.int64)}
    descriptors = np.zeros((len(points), 0), np.float32)
    return {"points_in_camera": points, "descriptors": descriptors, **known}


def stepped(recording, images, **options):
    estimator = FastSLAM(**{**K, "n_particles": 20, **options})
    estimator.reset(tracking_prior(recording), np.random.default_rng(0))
    return estimator, [
        estimator.step(Frame(0.5 * i, 0.5, np.array([0.05, 0.04]), {"stereo": image}))
        for i, image in enumerate(images)
    ]


@pytest.mark.parametrize("proposal", ["motion", "optimal"])
@pytest.mark.parametrize("association", ["known", "mahalanobis"])
def test_nothing_in_sight_for_a_hundred_images(recording, proposal, association):
    images = [seen([[0.0, 0.0, 2.0]], [5])] + [seen([], [])] * 120 + [seen([[0, 0, 2.0]], [5])]
    _, beliefs = stepped(recording, images, proposal=proposal, association=association)
    status = [belief.extras.get("status", "ok") for belief in beliefs]
    assert status[99] == "ok"
    assert status[100] == "no landmark in 100 images"
    assert status[-1] == "ok"
    areas = [np.linalg.det(belief.covariance[:2, :2]) for belief in beliefs]
    assert areas[100] > areas[10] > areas[1]
    assert all(np.isfinite(belief.mean).all() for belief in beliefs)


def test_duplicate_ids_and_useless_points_are_rejected_and_reported(recording):
    good, again = [0.1, 0.0, 2.0], [0.4, 0.0, 2.5]
    estimator, beliefs = stepped(
        recording,
        [
            seen([good, again], [7, 7]),
            seen([good, [0.0, 0.0, 0.0]], [7, 8]),
            seen([[np.nan, 0.0, 1.0], good], [9, 7]),
            seen([good], [7]),
        ],
    )
    assert [belief.extras.get("status") for belief in beliefs] == [
        "duplicate id rejected",
        "observation without depth rejected",
        "observation without depth rejected",
        None,
    ]
    assert [belief.extras["associations"].tolist() for belief in beliefs] == [
        [0, -1],
        [0, -1],
        [-1, 0],
        [0],
    ]
    assert estimator.map["ids"].tolist() == [7]


def test_weights_that_all_underflow_are_told_and_forgotten(recording, monkeypatch):
    image = seen([[0.0, 0.0, 2.0]], [5])
    hopeless = lambda state, n: np.full(n, -np.inf)  # noqa: E731
    monkeypatch.setattr(fastslam.ekf, "log_weights", hopeless)
    estimator, beliefs = stepped(recording, [image, image, image])
    assert beliefs[-1].extras["status"] == "weights underflowed"
    assert np.isfinite(beliefs[-1].mean).all()
    assert beliefs[-1].extras["ess"] == pytest.approx(20.0)
    assert np.isfinite(estimator.finish().means).all()


def test_frames_without_an_image_roll_on(recording):
    """Encoder readings between images change neither the draws nor the posterior."""
    whole, parts = (FastSLAM(n_particles=2000, **K) for _ in range(2))
    for estimator in (whole, parts):
        estimator.reset(tracking_prior(recording), np.random.default_rng(0))
    for i in range(4):
        depth = 3.0 - 0.2 * i
        image = seen([[0.0, 0.0, depth], [0.5, 0.1, depth + 1.0]], [5, 6])
        last = whole.step(Frame(float(i), 1.0, np.array([0.2, 0.2]), {"stereo": image}))
        for k in range(4):
            frame = Frame(i + k / 4.0, 0.25, np.array([0.05, 0.05]))
            between = parts.step(frame if k < 3 else with_reading(frame, "stereo", **image))
    sigma = np.sqrt(np.diagonal(last.covariance))
    assert np.all(np.abs(last.mean - between.mean) < 0.3 * sigma)
    assert np.allclose(np.sqrt(np.diagonal(between.covariance)), sigma, rtol=0.2)


def test_motion_is_drawn_by_itself_when_it_grows(recording):
    blind = FastSLAM(n_particles=2000, **K)
    prior = tracking_prior(recording)
    blind.reset(prior, np.random.default_rng(0))
    odometry = Odometry(**K)
    odometry.reset(prior, np.random.default_rng(0))
    for i in range(200):
        frame = Frame(0.1 * i, 0.1, np.array([0.05, 0.04]))
        ours, theirs = blind.step(frame), odometry.step(frame)
    sigma = np.sqrt(np.diagonal(theirs.covariance))
    assert np.all(np.abs(ours.mean - theirs.mean) < 0.5 * sigma)
    assert np.sqrt(ours.covariance[2, 2]) == pytest.approx(sigma[2], rel=0.1)


def test_best_particle_carries_its_weight_along_the_ancestry(recording):
    """gil2008, eq. (20): the sum is the lineage's, so resampling does not reset it."""
    estimator = FastSLAM(n_particles=40, proposal="motion", ess_share=1.0, **K)
    estimator.reset(tracking_prior(recording), np.random.default_rng(0))
    resampled = 0
    for frame in recording.cut(60).frames():
        before = estimator._accumulated.copy()
        belief = estimator.step(frame)
        if belief.extras["resampled"]:
            resampled += 1
            summed = before + belief.extras["log_weights"]
            assert np.isin(estimator._accumulated, summed).all()
    assert resampled > 20
    assert not belief.extras["resampled"]
    assert np.array_equal(estimator.finish().means[-1], belief.extras["best"])


@pytest.mark.parametrize("proposal", ["motion", "optimal"])
def test_images_that_never_show_a_landmark(proposal):
    """Without a single observation a recording holds no ids; the wheels carry on."""
    recording = circle(n_frames=20)
    estimator = FastSLAM(n_particles=20, proposal=proposal, association="known", kr=1e-5, kl=1e-5)
    estimator.reset(tracking_prior(recording), np.random.default_rng(0))
    for frame in recording.frames():
        if "stereo" in frame.readings:
            frame = with_reading(frame, "stereo", **seen([]))
        belief = estimator.step(frame)
    assert np.isfinite(belief.mean).all()
    assert np.isfinite(belief.covariance).all()
