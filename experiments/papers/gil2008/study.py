"""The studies of gil2008: particles, distance, observations, association, noise, cost.

A world is driven through once; what else a run needs is drawn anew over the true path: wheel errors
by the law of k |ds|, and images with the simulator's own camera. Images are taken with every
landmark up to 20 m, and an arm keeps those within its dmax, and B of them: so arms share their
noise. Parameters were chosen on seeds below 100; what is judged here comes from 1000 on.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from estimators.base import Estimate, Prior
from estimators.base import run as walk
from estimators.ekf_slam import EkfSlam
from estimators.fastslam import FastSLAM
from estimators.odometry import Odometry
from estimators.smoother import Smoother
from experiments.evaluation.metrics import (
    aligned,
    alignment,
    heading_errors_rad,
    position_errors_m,
    rms,
)
from experiments.report.claims import Claim
from experiments.runs.compose import compose
from experiments.runs.experiment import Config, default_cache, make_recording
from experiments.runs.row import write_frame
from experiments.runs.seeds import stream
from sim import se2
from sim.recording import LandmarkLog, Recording, WheelLog
from sim.sensors import StereoCamera
from sim.simulate import _ExactRays, _Landmarks
from sim.world import World

Array = NDArray[np.float64]
Tables = dict[str, pd.DataFrame]
Profile = Literal["quick", "full"]
Rule = Literal["random", "nearest"]
Rows = list[dict[str, Any]]

PAPER = "gil2008"
JUDGED_SEED = 1000  # seeds 0-99 are for tuning
PARTICLES = (10, 50, 100, 200, 300, 500, 1000)
DISTANCES_M = (3.0, 5.0, 10.0, 20.0)
OBSERVATIONS = (1, 2, 4, 8, 12, 20)
FARTHEST_M = max(DISTANCES_M)
FEW = 8  # B where the distance is what varies
DESCRIPTOR_SIGMAS = (0.05, 0.9, 1.3, 1.7)
ALIKE_SHARE = 0.3
P0S = (1e-6, 1e-3, 1e-1)
# Thresholds found on seeds below 100; with descriptors the gate may be wide.
D0S = {"paper": 7.81, "pixel": 16.27}
WIDE_D0 = 40.0
NOISES_PX = (1.0, 3.0, 10.0)
K_M = 5e-5
LAG_M = 20.0  # ground is revisited when the robot is where it was this much path ago
BASE = (
    "world=gil2008",
    "robot=gil2008",
    "route.distance_m=146",
    "sensors=stereo_paper",
    "sensors.encoder.rate_hz=5",  # an arc over 0.4 m misses more of a bend than slip adds
    f"sensors.stereo.max_distance_m={FARTHEST_M:g}",
    "simulation.physics=kinematic",
    "simulation.rays=exact",
)
# The filter as printed, and FastSLAM 1.0 and 2.0 as one would use them.
FILTERS: dict[str, dict[str, Any]] = {
    "paper": {
        "proposal": "motion",
        "resampling": "multinomial",
        "ess_share": 1.0,
        "noise_model": "diagonal",
    },
    "fastslam1": {"proposal": "motion"},
    "fastslam2": {"proposal": "optimal"},
}


@dataclass(frozen=True)
class Scene:
    """What a recording is made of.

    Attributes
    ----------
    seed
        Of the world and the drive through it.
    draw
        0: the drive's own wheel errors; others are drawn anew.
    noise
        `paper`: 10 px, X, Y and Z drawn apart. `pixel`: 1 px, in the image.
    occluded
        Whether walls hide landmarks.
    sigma_px
        Of column and row, in place of the noise's own.
    sigma_descriptor, alike_share
        Noise of the descriptors; share of landmarks that have another one's.
    """

    seed: int
    draw: int = 0
    noise: str = "paper"
    occluded: bool = True
    sigma_px: float | None = None
    sigma_descriptor: float = 0.05
    alike_share: float = 0.0


@dataclass(frozen=True)
class Arm:
    """Runs over a scene: what of it the filter gets, and the filter.

    Attributes
    ----------
    table
        Where the rows go.
    label
        Columns that name the arm.
    max_distance_m, n_seen, rule
        dmax, B (0 for all) and how they are chosen.
    options
        Of FastSLAM; None for the batch, or `ekf` with those of EkfSlam.
    repeats
        Runs with other random numbers.
    """

    table: str
    label: tuple[tuple[str, Any], ...]
    options: tuple[tuple[str, Any], ...]
    max_distance_m: float = 10.0
    n_seen: int = 0
    rule: Rule = "random"
    method: Literal["fastslam", "ekf_slam", "batch"] = "fastslam"
    repeats: int = 1


def drive(seed: int) -> Recording:
    """The drive through a world, with the wheels read at 5 Hz."""
    return make_recording(configuration(seed), default_cache())


def configuration(seed: int) -> Config:
    """Resolved configuration of a drive."""
    return compose([*BASE, f"seed={seed}"])


def camera_of(scene: Scene) -> StereoCamera:
    """The camera that a scene's images are taken with."""
    sigma = {"paper": 10.0, "pixel": 1.0}[scene.noise] if scene.sigma_px is None else scene.sigma_px
    return StereoCamera(
        rate_hz=1.25,
        max_distance_m=FARTHEST_M,
        sigma_column_px=sigma,
        sigma_row_px=sigma,
        correlated=scene.noise == "pixel",
        sigma_descriptor=scene.sigma_descriptor,
    )


class _NoWalls:
    """Rays that nothing stops."""

    def sees(self, origin: Array, points: Array) -> NDArray[np.bool_]:
        return np.ones(len(points), np.bool_)


def recorded(scene: Scene) -> Recording:
    """The scene's recording: every landmark up to 20 m in every image, with its id."""
    driven, camera = drive(scene.seed), camera_of(scene)
    assert driven.truth is not None
    assert driven.landmarks is not None
    world = driven.truth.world
    assert world is not None
    name = dataclasses.replace(scene, sigma_descriptor=0.0)
    rng = stream(scene.seed, f"gil2008/images/{name}")
    world = _alike(world, scene.alike_share, rng)
    eye = _Landmarks(world, camera, rng)
    rays: Any = _ExactRays(world, None) if scene.occluded else _NoWalls()
    stamps = driven.landmarks.stamps
    images = [eye.observe(rays, pose) for pose in driven.truth_at(stamps)]
    points, ids, descriptors = (list(part) for part in zip(*images, strict=True))
    true_ids = np.concatenate(ids)
    log = LandmarkLog(
        stamps,
        np.cumsum([0, *(len(i) for i in ids)]),
        np.concatenate(points),
        true_ids,
        np.concatenate(descriptors),
    )
    return dataclasses.replace(
        driven,
        landmarks=log,
        wheels=driven.wheels if scene.draw == 0 else _wheels(driven, scene),
        sensors=dataclasses.replace(driven.sensors, stereo=camera),
        truth=dataclasses.replace(driven.truth, landmark_ids=true_ids, world=world),
    )


def _wheels(driven: Recording, scene: Scene) -> WheelLog:
    """Encoders that err anew over the same true travel, by the law of k |ds|."""
    assert driven.truth is not None
    rng = stream(scene.seed, "gil2008/wheels", scene.draw)
    ground = np.diff(driven.truth.wheel_travel_m, axis=0, prepend=0.0)
    error = np.sqrt(K_M * np.abs(ground)) * rng.standard_normal(ground.shape)
    return WheelLog(driven.truth.stamps, np.cumsum(ground + error, axis=0))


def _alike(world: World, share: float, rng: np.random.Generator) -> World:
    """The world in which a share of the landmarks has the descriptor of another one of them."""
    n = 2 * round(share * len(world.landmarks) / 2)
    first, second = rng.permutation(len(world.landmarks))[:n].reshape(2, -1)
    descriptors, twins = world.descriptors.copy(), np.zeros(len(world.landmarks), bool)
    descriptors[second] = descriptors[first]
    twins[[*first, *second]] = True
    return dataclasses.replace(world, descriptors=descriptors, look_alike=twins)


def thinned(
    recording: Recording, arm: Arm, rng: np.random.Generator
) -> tuple[Recording, dict[str, float]]:
    """The recording as an arm's camera gives it, and what its images show.

    Landmarks are kept by their true distance; the same random order decides for every B, so
    fewer observations are a part of more.
    """
    log, truth, camera = recording.landmarks, recording.truth, recording.sensors.stereo
    assert log is not None
    assert truth is not None
    assert truth.world is not None
    assert camera is not None
    image = np.repeat(np.arange(len(log.stamps)), np.diff(log.splits))
    where = recording.truth_at(log.stamps)[image]
    eye = np.column_stack([where[:, :2], np.full(len(where), camera.mount.z_m)])
    distance = np.linalg.norm(truth.world.landmarks[truth.landmark_ids] - eye, axis=1)
    order = distance if arm.rule == "nearest" else rng.random(len(distance))
    near = distance <= arm.max_distance_m
    ranked = np.lexsort((order, ~near, image))
    rank = np.empty(len(image), np.int64)
    rank[ranked] = np.arange(len(image)) - log.splits[image[ranked]]
    kept = near & (rank < arm.n_seen) if arm.n_seen else near
    splits = np.concatenate([[0], np.cumsum(kept)])[log.splits]
    names = dict(arm.options).get("association", "known") == "known"
    thin = dataclasses.replace(
        log,
        splits=splits,
        points_in_camera=log.points_in_camera[kept],
        ids=log.ids[kept] if names else np.zeros(0, np.int64),
        descriptors=log.descriptors[kept],
    )
    seen = dataclasses.replace(camera, max_distance_m=arm.max_distance_m, identifies=names)
    shown = {
        "observations_per_image": float(np.mean(np.diff(splits))),
        "share_beyond_10_m": float(np.mean(distance[kept] > 10.0)) if kept.any() else 0.0,
    }
    answer = dataclasses.replace(
        recording,
        landmarks=thin,
        sensors=dataclasses.replace(recording.sensors, stereo=seen),
        truth=dataclasses.replace(truth, landmark_ids=truth.landmark_ids[kept]),
    )
    return answer, shown


def prior_of(recording: Recording) -> Prior:
    """The true start, known."""
    assert recording.truth is not None
    start = recording.truth.poses[0].copy()
    return Prior(recording.robot, recording.sensors, start, np.zeros((3, 3)))


def runs_of(scene: Scene, arms: Sequence[Arm]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Table and row of every run over one scene."""
    recording = recorded(scene)
    truth = recording.truth_at(recording.frame_stamps)
    odometry = walk(Odometry(K_M, K_M), recording, prior_of(recording), stream(0, "odometry"))
    common = {
        **dataclasses.asdict(scene),
        "odometry_rmse_m": rms(position_errors_m(truth, odometry.means)),
        "odometry_slope": revisited_slope(truth, odometry.means),
        "matching_precision": matching_precision(recording),
    }
    for arm in arms:
        thin, shown = thinned(recording, arm, stream(scene.seed, "gil2008/choice", scene.draw))
        name = f"estimator/{arm.table}/{dict(arm.label)}"
        for repeat in range(arm.repeats):
            rng = stream(scene.seed, name, 100 * scene.draw + repeat)
            row = one_run(thin, arm, rng)
            yield (
                arm.table,
                {
                    **common,
                    **dict(arm.label),
                    "max_distance_m": arm.max_distance_m,
                    "n_seen": arm.n_seen,
                    "rule": arm.rule,
                    "repeat": repeat,
                    **shown,
                    **row,
                },
            )


def one_run(recording: Recording, arm: Arm, rng: np.random.Generator) -> dict[str, Any]:
    """Scores of one run."""
    estimate, revised, seconds = estimated(recording, arm, rng)
    truth = recording.truth_at(estimate.stamps)
    best = aligned(truth, revised.means)
    row = {
        "status": estimate.status,
        "online_rmse_m": rms(position_errors_m(truth, estimate.means)),
        "online_aligned_rmse_m": rms(position_errors_m(truth, aligned(truth, estimate.means))),
        "revised_rmse_m": rms(position_errors_m(truth, revised.means)),
        "revised_aligned_rmse_m": rms(position_errors_m(truth, best)),
        "heading_rmse_rad": rms(heading_errors_rad(truth, revised.means)),
        "slope": revisited_slope(truth, revised.means),
        "final_error_m": float(position_errors_m(truth[-1:], estimate.means[-1:])[0]),
        "step_mean_us": 1e6 * seconds,
        **map_scores(recording, revised.map),
    }
    if "resampled" in estimate.extras:
        images = [a is not None for a in estimate.extras["associations"]]
        row["resampled_share"] = float(np.mean(np.array(estimate.extras["resampled"])[images]))
    if any(a is not None for a in estimate.extras.get("associations", [])):
        row["right_share"] = right_share(recording, estimate.extras["associations"])
    return row


def estimated(
    recording: Recording, arm: Arm, rng: np.random.Generator
) -> tuple[Estimate, Estimate, float]:
    """Online and revised estimate of an arm, and seconds of a step."""
    keep: tuple[str, ...] = ()
    estimator: Any
    if arm.method == "batch":
        estimator = Smoother(K_M, K_M)
    elif arm.method == "ekf_slam":
        estimator, keep = EkfSlam(kr=K_M, kl=K_M, **dict(arm.options)), ("associations",)
    else:
        estimator = FastSLAM(kr=K_M, kl=K_M, **dict(arm.options))
        keep = ("associations", "resampled")
    online = walk(estimator, recording, prior_of(recording), rng, keep)
    revised = estimator.finish() if hasattr(estimator, "finish") else online
    return online, revised, float(online.step_seconds.mean())


def map_scores(recording: Recording, found: Any) -> dict[str, float]:
    """RMS distances of the map's landmarks from the true ones, raw and aligned in the plane."""
    if not isinstance(found, dict) or "ids" not in found or len(found["ids"]) < 2:
        return {}
    assert recording.truth is not None
    assert recording.truth.world is not None
    true, made = recording.truth.world.landmarks[found["ids"]], found["landmarks"]
    flat_true, flat = (np.column_stack([p[:, :2], np.zeros(len(p))]) for p in (true, made))
    fitted = made.copy()
    fitted[:, :2] = se2.transform(alignment(flat_true, flat), made[:, :2])
    return {
        "n_landmarks": len(true),
        "map_rmse_m": rms(np.linalg.norm(made - true, axis=1)),
        "map_aligned_rmse_m": rms(np.linalg.norm(fitted - true, axis=1)),
    }


def right_share(recording: Recording, associations: Sequence[NDArray[np.int64] | None]) -> float:
    """Share of observations given to the landmark they are of.

    An observation that starts a landmark is right if that one had not been seen before.
    """
    assert recording.truth is not None
    told = recording.truth.landmark_ids
    given = np.concatenate([a for a in associations if a is not None])
    own = np.arange(len(told))
    first = np.zeros(len(told), bool)
    first[np.unique(told, return_index=True)[1]] = True
    right = np.where(given == own, first, told[given] == told)
    return float(np.mean(right & (given >= 0)))


def matching_precision(recording: Recording) -> float:
    """Share of observations whose descriptor is nearest to that of their landmark's first one."""
    log, truth = recording.landmarks, recording.truth
    assert log is not None
    assert truth is not None
    ids, first = np.unique(truth.landmark_ids, return_index=True)
    again = np.ones(len(truth.landmark_ids), bool)
    again[first] = False
    nearest = np.argmax(log.descriptors[again] @ log.descriptors[first].T, axis=1)
    return float(np.mean(ids[nearest] == truth.landmark_ids[again]))


def revisited(truth: Array) -> NDArray[np.bool_]:
    """Rows (T,) where the robot is within a metre of where it was at least 20 m of path ago."""
    travelled = travelled_m(truth)
    near = np.hypot(*(truth[:, None, :2] - truth[None, :, :2]).transpose(2, 0, 1)) < 1.0
    ago = travelled[:, None] - travelled[None, :] > LAG_M
    answer: NDArray[np.bool_] = np.any(near & ago, axis=1)
    return answer


def travelled_m(truth: Array) -> Array:
    """Path (T,) behind the robot."""
    steps = np.hypot(*np.diff(truth[:, :2], axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def revisited_slope(truth: Array, means: Array) -> float:
    """Growth of the position error by distance over revisited ground, m per m."""
    rows = np.flatnonzero(revisited(truth[::4])) * 4
    if len(rows) < 10:
        return float("nan")
    errors = position_errors_m(truth, means)
    return float(np.polyfit(travelled_m(truth)[rows], errors[rows], 1)[0])


def options(filter_name: str, **more: Any) -> tuple[tuple[str, Any], ...]:
    """A filter's options, and others."""
    return tuple({**FILTERS[filter_name], **more}.items())


def _arm(
    table: str, filter_name: str, more: dict[str, Any], label: dict[str, Any], **rest: Any
) -> Arm:
    named = tuple({"filter": filter_name, **label}.items())
    return Arm(table, named, options(filter_name, **more), **rest)


def plan(profile: Profile) -> dict[Scene, list[Arm]]:
    """All scenes, and the arms that run over each; quick, the same ones over fewer worlds."""
    full = profile == "full"
    seeds = range(JUDGED_SEED, JUDGED_SEED + (20 if full else 2))
    arms: dict[Scene, list[Arm]] = {}

    def add(scene: Scene, arm: Arm) -> None:
        arms.setdefault(scene, []).append(arm)

    for seed, noise in itertools.product(seeds, ("paper", "pixel")):
        scene, judged = Scene(seed, noise=noise), noise == "paper"
        for m, name in itertools.product(PARTICLES, ("paper", "fastslam2")):
            if judged or name == "fastslam2":
                add(scene, _arm("particles", name, {"n_particles": m}, {"n_particles": m}))
        add(scene, Arm("bound", (("filter", "batch"),), (), method="batch"))
        for b, name in itertools.product(OBSERVATIONS, ("paper", "fastslam2")):
            if judged:
                add(scene, _arm("observations", name, {"n_particles": 200}, {}, n_seen=b))
    for seed, draw in itertools.product(seeds, range(1, 5 if full else 2)):
        for m, name in itertools.product((200, 1000), ("paper", "fastslam2")):
            more = {"n_particles": m}
            add(Scene(seed, draw=draw), _arm("particles", name, more, more))
    for m, name in itertools.product(PARTICLES, ("paper", "fastslam2")):
        more = {"n_particles": m}
        arm = _arm("repeats", name, more, more, repeats=20 if full else 3)
        add(Scene(JUDGED_SEED), arm)
    for seed in seeds:
        _distance_arms(add, seed)
        _association_arms(add, seed)
        _setting_arms(add, seed)
    return arms


def _distance_arms(add: Callable[[Scene, Arm], None], seed: int) -> None:
    """Figure 9: dmax, by what is observed, with and without walls."""
    more = {"n_particles": 200}
    for distance in DISTANCES_M:
        kinds: list[tuple[str, bool, str, int, Rule]] = [
            ("fastslam2", True, "paper", 0, "random"),
            ("fastslam2", True, "paper", FEW, "random"),
            ("fastslam2", True, "paper", FEW, "nearest"),
            ("fastslam2", False, "paper", 0, "random"),
            ("fastslam2", False, "paper", FEW, "random"),
            ("paper", True, "paper", 0, "random"),
            ("fastslam2", True, "pixel", 0, "random"),
        ]
        for name, occluded, noise, b, rule in kinds:
            arm = _arm("distance", name, more, {}, max_distance_m=distance, n_seen=b, rule=rule)
            add(Scene(seed, noise=noise, occluded=occluded), arm)


def _association_arms(add: Callable[[Scene, Arm], None], seed: int) -> None:
    """Known association, and what distance and descriptors find."""
    more = {"n_particles": 200}
    for noise, sigma in itertools.product(("paper", "pixel"), DESCRIPTOR_SIGMAS):
        main = sigma == DESCRIPTOR_SIGMAS[1]
        if not main and noise == "pixel":
            continue
        scene = Scene(seed, noise=noise, sigma_descriptor=sigma, alike_share=ALIKE_SHARE)

        def guess(association: str, p0: float, scene: Scene = scene) -> None:
            named: dict[str, Any] = {"association": association, "p0": p0}
            d0 = WIDE_D0 if association == "descriptor" else D0S[scene.noise]
            add(scene, _arm("association", "fastslam2", {**more, **named, "d0": d0}, named))

        guess("descriptor", P0S[1])
        if main:
            guess("known", P0S[1])
            for p0 in P0S if noise == "paper" else P0S[1:2]:
                guess("mahalanobis", p0)
            choice = ("association", "mahalanobis")
            label = (("filter", "ekf_slam"), choice, ("p0", P0S[1]))
            told = (choice, ("d0", D0S[noise]))
            add(scene, Arm("association", label, told, method="ekf_slam"))


def _setting_arms(add: Callable[[Scene, Arm], None], seed: int) -> None:
    """Resampling, and where the noise is taken."""
    more = {"n_particles": 200}
    for scheme, share in itertools.product(
        ("systematic", "stratified", "residual", "multinomial"), (0.5, 1.0)
    ):
        settings = {"resampling": scheme, "ess_share": share}
        add(Scene(seed), _arm("resampling", "fastslam1", {**more, **settings}, settings))
    for sigma, at in itertools.product(NOISES_PX, ("predicted", "measured")):
        scene = Scene(seed, noise="pixel", sigma_px=sigma)
        add(scene, _arm("noise", "fastslam2", {**more, "noise_at": at}, {"noise_at": at}))


def run(profile: Profile, out: Path, on_progress: Callable[[float], None]) -> Tables:
    """Run all studies of the paper and write their tables to `out`.

    Parameters
    ----------
    profile
        `quick`: few recordings; `full`: what the claims are judged by.
    out
        Folder of the tables.
    on_progress
        Called with the share done.
    """
    from joblib import Parallel, delayed

    from experiments.bench.fastslam import cost_by_landmarks

    planned = plan(profile)
    seeds = sorted({scene.seed for scene in planned})
    parallel = Parallel(n_jobs=-1, return_as="generator")
    for done, _ in enumerate(parallel(delayed(_driven)(seed) for seed in seeds), start=1):
        on_progress(0.1 * done / len(seeds))
    parts = [
        (scene, part)
        for scene, arms in planned.items()
        for part in (arms[i : i + 40] for i in range(0, len(arms), 40))
    ]
    tables = tables_of(parts, lambda share: on_progress(0.1 + 0.85 * share))
    tables["cost"] = cost_by_landmarks(5 if profile == "full" else 2)
    for name, frame in tables.items():
        write_frame(frame, out / f"{PAPER}_{name}.csv")
    on_progress(1.0)
    return tables


def tables_of(
    parts: Sequence[tuple[Scene, Sequence[Arm]]],
    on_progress: Callable[[float], None] = lambda _: None,
    n_jobs: int = -1,
) -> Tables:
    """Rows of all runs, by table; they do not depend on the number of processes."""
    from joblib import Parallel, delayed

    rows: dict[str, Rows] = {}
    jobs = (delayed(_job)(scene, arms) for scene, arms in parts)
    done = Parallel(n_jobs=n_jobs, return_as="generator")(jobs)
    for number, part in enumerate(done, start=1):
        for table, row in part:
            rows.setdefault(table, []).append(row)
        on_progress(number / len(parts))
    return {table: pd.DataFrame(part) for table, part in rows.items()}


def _driven(seed: int) -> None:
    drive(seed)


def _job(scene: Scene, arms: Sequence[Arm]) -> list[tuple[str, dict[str, Any]]]:
    return list(runs_of(scene, arms))


def claims(tables: Tables, *, quick: bool) -> list[Claim]:
    """Judge GI1-GI8 by the tables."""
    from experiments.papers.gil2008 import claims as judge

    judged = [
        *judge.gi1(tables["particles"]),
        *judge.gi2(tables["particles"], tables["bound"]),
        *judge.gi3(tables["particles"]),
        *judge.gi4(tables["distance"]),
        *judge.gi5(tables["distance"]),
        *judge.gi6(tables["observations"]),
        *judge.gi7(tables["association"]),
        *judge.gi8(tables["cost"]),
    ]
    command = "estima reproduce --paper gil2008" + ("" if quick else " --full")
    return [claim.completed(study=PAPER, command=command, quick=quick) for claim in judged]


def figures(tables: Tables) -> dict[str, Figure]:
    """Draw all figures of the paper, by file name."""
    from experiments.papers.gil2008 import figures as draw

    return draw.all_figures(tables)
