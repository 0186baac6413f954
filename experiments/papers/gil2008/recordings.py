"""The recordings of gil2008: one drive through each world, with images drawn over it.

Each world is driven through once. Whatever else a run needs is drawn over the true path: other
wheel errors by the law of k |ds|, and images by the simulator's own camera. Images hold every
landmark within 20 m; a run keeps those within its dmax, and B of them, so runs share their noise.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.papers.gil2008.settings import FARTHEST_M
from experiments.runs.experiment import Experiment
from experiments.runs.schema import Config
from experiments.runs.seeds import stream
from sim.arrays import Array
from sim.errors import InputError
from sim.recording import Log, Recording, WheelLog, log_of_readings
from sim.robot.slip import wheel_errors
from sim.sensors import StereoCamera, View, sensor_of
from sim.sensors.base import sensor_settings, split_schema
from sim.sensors.rays import ExactRays
from sim.worlds.world import World


@dataclass(frozen=True)
class Scene:
    """What a recording's images and wheel errors depend on. Its text names their stream.

    Attributes
    ----------
    seed
        Of the world and the drive through it.
    draw
        0: the drive's own wheel errors; others are drawn over the same path, with other images.
    image_draw
        Which of the draws of images over the same wheel errors.
    noise
        `paper`: X, Y and Z have independent noise. `pixel`: the noise is drawn in the image.
    occluded
        Whether walls hide landmarks.
    sigma_px
        Standard deviation, px, of images with noise of their own; None for those that all share.
    sigma_descriptor, alike_share
        Noise of the descriptors; share of landmarks that have the descriptor of another.
    """

    seed: int
    draw: int = 0
    image_draw: int = 0
    noise: str = "paper"
    occluded: bool = True
    sigma_px: float | None = None
    sigma_descriptor: float = 0.05
    alike_share: float = 0.0

    @classmethod
    def of(cls, experiment: Experiment) -> Scene:
        """Read an experiment's seed, its camera, and the options of its `recording`."""
        camera, given = _camera(experiment), experiment.options_of("recording")
        return cls(
            seed=experiment.seed,
            noise="pixel" if camera.correlated else "paper",
            sigma_descriptor=camera.sigma_descriptor,
            **{key: value for key, value in given.items() if key != "_target_"},
        )


def recorded(config: Config, **_scene: Any) -> Recording:
    """Make the recording of a configuration; `Scene.of` reads the keys of its `recording`."""
    experiment = Experiment(config)
    return thin(whole(experiment), experiment)


def whole(experiment: Experiment) -> Recording:
    """Recording of an experiment's scene: all landmarks within 20 m in every image, with ids."""
    scene, camera = Scene.of(experiment), _camera(experiment)
    driven = drive_of(experiment).recording()
    # the images do not depend on the noise of the descriptors
    rng = stream(scene.seed, f"gil2008/images/{dataclasses.replace(scene, sigma_descriptor=0.0)}")
    world = _alike(driven.known_world, scene.alike_share, rng)
    camera = dataclasses.replace(
        camera,
        max_distance_m=max(FARTHEST_M, camera.max_distance_m),
        max_observations=0,
        identifies=True,
    )
    eye = camera.start(rng)
    rays: Any = ExactRays(world) if scene.occluded else _NoWalls()
    stamps = driven.log("stereo").stamps
    poses = driven.truth_at(stamps)
    eye.begin(View(stamps[0], poses[0], world, rays, stamps[0], poses[0]))
    images = [
        eye(View(stamp, pose, world, rays, stamp, pose))
        for stamp, pose in zip(stamps.tolist(), poses, strict=True)
    ]
    seen, hidden = split_schema(camera.schema)
    log, true = (log_of_readings(schema, stamps, images, "images") for schema in (seen, hidden))
    driven = driven.with_log("stereo", log, camera)
    return dataclasses.replace(
        driven,
        wheels=driven.wheels if scene.draw == 0 else _wheels(driven, scene, experiment),
        truth=dataclasses.replace(
            driven.known_truth, readings={"stereo": true.values}, world=world
        ),
    )


def thin(recording: Recording, experiment: Experiment) -> Recording:
    """Recording as an experiment's camera would take it.

    Landmarks are kept by their true distance. The same random order is used for every B, so the
    observations of a smaller B are a subset of those of a larger one.
    """
    log, truth = recording.log("stereo"), recording.known_truth
    camera, scene = _camera(experiment), Scene.of(experiment)
    rng = stream(scene.seed, "gil2008/choice", scene.draw)
    splits = log.known_splits
    image = np.repeat(np.arange(len(log.stamps)), np.diff(splits))
    distance = landmark_distances_m(recording)
    order = distance if camera.selection == "nearest" else rng.random(len(distance))
    kept = distance <= camera.max_distance_m
    if camera.max_observations:
        ranked = np.lexsort((order, ~kept, image))
        rank = np.empty(len(image), np.int64)
        rank[ranked] = np.arange(len(image)) - splits[image[ranked]]
        kept &= rank < camera.max_observations
    schema, _ = split_schema(camera.schema)
    left = Log.of(
        camera,
        log.stamps,
        np.concatenate([[0], np.cumsum(kept)])[splits],
        **{name: log[name][kept] for name in schema},
    )
    true = {name: values[kept] for name, values in truth.readings["stereo"].items()}
    return dataclasses.replace(
        recording.with_log("stereo", left, camera),
        truth=dataclasses.replace(truth, readings={"stereo": true}),
    )


def landmark_distances_m(recording: Recording) -> Array:
    """True distance (K,) from the camera to the landmark of each observation, m."""
    log, camera = recording.log("stereo"), recording.sensor("stereo", StereoCamera)
    where = np.repeat(recording.truth_at(log.stamps), np.diff(log.known_splits), axis=0)
    where[:, 2] = camera.mount.z_m
    true = recording.known_world.landmarks[true_ids(recording)]
    return np.asarray(np.linalg.norm(true - where, axis=1))


def true_ids(recording: Recording) -> NDArray[np.int64]:
    """True landmark (K,) of each observation."""
    return recording.known_truth.readings["stereo"]["true_ids"]


def drive_of(experiment: Experiment) -> Experiment:
    """Drive of an experiment's robot; it does not depend on the camera."""
    camera = sensor_settings(StereoCamera(rate_hz=_camera(experiment).rate_hz))
    sensors = {**experiment.options_of("sensors"), "stereo": camera}
    return experiment.with_values(recording=None, sensors=sensors)


def _camera(experiment: Experiment) -> StereoCamera:
    camera = sensor_of(experiment.sensors(), "stereo", StereoCamera)
    if camera.selection == "spread":
        raise InputError("gil2008 needs sensors.stereo.selection=random or nearest, got spread")
    return camera


class _NoWalls:
    """Rays without walls."""

    def sees(self, origin: Array, points: Array) -> NDArray[np.bool_]:
        return np.ones(len(points), np.bool_)


def _wheels(driven: Recording, scene: Scene, experiment: Experiment) -> WheelLog:
    """Encoders with other errors over the same true travel, by the law of k |ds|."""
    robot, truth = experiment.robot(), driven.known_truth
    rng = stream(scene.seed, "gil2008/wheels", scene.draw)
    ground = np.diff(truth.wheel_travel_m, axis=0, prepend=0.0)
    error = wheel_errors(ground, [robot.kr, robot.kl], rng)
    return WheelLog(truth.stamps, np.cumsum(ground + error, axis=0))


def _alike(world: World, share: float, rng: np.random.Generator) -> World:
    """World in which a share of the landmarks has the descriptor of another landmark."""
    n = 2 * round(share * len(world.landmarks) / 2)
    first, second = rng.permutation(len(world.landmarks))[:n].reshape(2, -1)
    descriptors, twins = world.descriptors.copy(), np.zeros(len(world.landmarks), bool)
    descriptors[second] = descriptors[first]
    twins[[*first, *second]] = True
    return dataclasses.replace(world, descriptors=descriptors, look_alike=twins)
