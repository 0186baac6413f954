"""From an image to observations and their landmarks, the same for every landmark filter.

Shared by `estimators.landmarks.ekf_slam` and `estimators.landmarks.fastslam`, whose filters choose
landmarks by distance themselves. `screened` also serves `estimators.graph.landmark_drive`.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri  # scipy.stats takes half a second to import

from estimators.base import Prior
from estimators.landmarks.stereo import NoiseAt, NoiseModel, StereoModel, TeamEyesOptions
from estimators.wheels import WheelOptions
from sim.arrays import Array, Floats, Ints
from sim.errors import require
from sim.options import NonNegative, Positive, Probability, options
from sim.recording import Frame

Association = Literal["known", "mahalanobis", "descriptor"]

_SIGMAS = ("sigma_column_px", "sigma_row_px", "sigma_disparity_px", "sigma_descriptor")
_BLIND_IMAGES = 100  # images without a landmark after which the status reports it


@options("estimator")
class LandmarkSlamOptions(WheelOptions, TeamEyesOptions):
    """What the filters of landmark SLAM have in common."""

    association: Association = "known"
    """`known`: by the ids that the sensor gives. `mahalanobis`: least distance below `d0`, gil2008,
    eq. (15). `descriptor`: of those below `d0`, the one that distance and descriptor together
    favour."""
    d0: Positive = 16.27
    """Threshold of the squared Mahalanobis distance (99.9 % of three degrees of freedom)."""
    noise_model: NoiseModel = "camera"
    """`diagonal`: R of gil2008, eqs. (10)-(12). `correlated`: with the terms beside the diagonal.
    `image`: image coordinates. `camera`: `image` if the camera's noise is correlated, else
    `diagonal`, which is how each is made."""
    noise_at: NoiseAt = "predicted"
    """Point at which R is taken: `predicted` or `measured`."""
    sigma_column_px: NonNegative | None = None
    """Believed noise of the column, px; null: the camera's own."""
    sigma_row_px: NonNegative | None = None
    """Believed noise of the row, px; null: the camera's own."""
    sigma_disparity_px: NonNegative | None = None
    """Believed noise of the disparity, px; null: the camera's own."""
    sigma_descriptor: NonNegative | None = None
    """Believed noise of descriptors; null: the camera's own."""
    gate_probability: Probability | None = None
    """Under known association, an observation less probable than this is left out, and a landmark
    enters the map only when two sightings in a row agree: a misread id is neither an update nor a
    landmark. null: every id is believed."""
    repeat_s: NonNegative = 0.0
    """Under known association, a landmark counts at most once in this time for each robot, s:
    errors of a sensor that last longer than an image would count again as if they were independent.
    0: in every image."""
    keep_map: bool = False
    """Put the map into every Belief; of FastSLAM, that of the best particle."""
    sighting_d0: Positive = 16.27
    """Squared Mahalanobis distance from which on a sighting is a misread robot, and rejected."""

    def __post_init__(self) -> None:
        require(
            self.association == "known" or (self.gate_probability is None and self.repeat_s == 0.0),
            "estimator.gate_probability and repeat_s apply to ids; leave them at null and 0 under "
            f"association={self.association}, which has the gate d0",
        )


@dataclass(frozen=True)
class Image:
    """The K observations of an image that can be used.

    Attributes
    ----------
    points
        (K, 3) m in the camera frame.
    numbers
        (K,) their numbers among all observations of the run, counted from 0.
    ids
        (K,); None where the sensor gives none.
    descriptors
        (K, D), D = 0 where it gives none.
    used
        (A,) which of all the image's observations these are.
    status
        What is wrong with the others; empty if nothing is.
    again
        (A,) which of all would count again too soon.
    """

    points: Array
    numbers: Ints
    ids: Ints | None
    descriptors: Floats
    used: NDArray[np.bool_]
    status: str
    again: NDArray[np.bool_]

    def select(self, kept: NDArray[np.bool_]) -> Image:
        """Return the image with these (K,) of its observations only."""
        used = self.used.copy()
        used[np.flatnonzero(used)[~kept]] = False
        ids = None if self.ids is None else self.ids[kept]
        parts = self.points[kept], self.numbers[kept], ids, self.descriptors[kept]
        return Image(*parts, used, self.status, self.again)


def screen(
    camera: StereoModel, points_in_camera: Array, ids: Ints | None
) -> tuple[NDArray[np.bool_], str]:
    """Which observations (A,) of an image can be used, and what is wrong with the others.

    Parameters
    ----------
    points_in_camera
        (A, 3) m.
    ids
        (A,), of duplicates only the first is used; None if they do not count.
    """
    used = camera.usable(points_in_camera)
    status = "" if used.all() else "observation without depth rejected"
    if ids is not None:
        rows = np.flatnonzero(used)
        first = np.unique(ids[rows], return_index=True)[1]
        if len(first) < len(rows):
            return np.isin(np.arange(len(used)), rows[first]), "duplicate id rejected"
    return used, status


class SlamFrontEnd:
    """The believed camera, the usable observations, and where each landmark came from.

    Landmarks are numbered in the order in which observations start them. Two unit descriptors of
    D independent components have a product of N(rho, 1 / D) if they show one landmark, rho =
    1 / (1 + sigma_descriptor^2), and of N(0, 1 / D) if not; twice the log of the ratio of these
    densities is the evidence for the same landmark.

    Parameters
    ----------
    believed
        Options of the method.
    prior
        Its camera and start pose are needed.
    estimator
        Name of the method, for error messages.

    Attributes
    ----------
    camera
        What is believed of the camera.
    first_pose
        The prior's pose in map.
    reach_m
        Distance within which a predicted landmark may be one that was seen.
    origins
        (N,) number of the observation that started each landmark.
    """

    def __init__(self, believed: LandmarkSlamOptions, prior: Prior, estimator: str) -> None:
        self.believed, self._estimator = believed, estimator
        camera = prior.require_stereo(believed.stereo, estimator)
        self.first_pose = prior.require_start(estimator)
        require(
            believed.association != "known" or camera.identifies,
            "the camera does not identify landmarks; set estimator.association=mahalanobis "
            "or descriptor",
        )
        believed_sigmas = ((name, getattr(believed, name)) for name in _SIGMAS)
        camera = dataclasses.replace(camera, **{k: v for k, v in believed_sigmas if v is not None})
        self.camera = StereoModel.of(camera, believed.noise_model, believed.noise_at)
        # a landmark may be predicted beyond dmax and still be the one that was seen
        self.reach_m = 1.5 * camera.max_distance_m + 1.0
        share = believed.gate_probability
        self._gate = math.inf if share is None else float(chdtri(3, share))
        self._rho = 1.0 / (1.0 + camera.sigma_descriptor**2)
        self.origins = np.zeros(0, np.int64)
        self._landmark_of_id: dict[int, int] = {}
        self._descriptors = np.zeros((0, 0), np.float32)  # of each landmark's first observation
        self._n_observations, self._n_blind = 0, 0
        self._tentative: dict[int, Array] = {}  # by id, where a first sighting places it in map
        self._last_s: dict[tuple[int, int], float] = {}  # by robot and id, when it counted last

    @property
    def identified(self) -> bool:
        """Whether landmarks are associated by the ids that the sensor gives."""
        return self.believed.association == "known"

    def read(self, frame: Frame) -> Image:
        """Observations of a Frame's image that can be used; of duplicate ids the first."""
        seen = frame.readings[self.believed.stereo]
        all_points, all_ids = seen["points_in_camera"], seen.get("ids")
        used, status = screen(self.camera, all_points, all_ids if self.identified else None)
        require(
            not (self.identified and all_ids is None and used.any()),
            f"{self._estimator}: observations without ids; set "
            "estimator.association=mahalanobis or descriptor",
        )
        self._n_blind = 0 if used.any() else self._n_blind + 1
        if self._n_blind >= _BLIND_IMAGES:
            status = f"no landmark in {self._n_blind} images"
        numbers = self._n_observations + np.flatnonzero(used)
        self._n_observations += len(used)
        ids = None if all_ids is None else all_ids[used]
        points = np.ascontiguousarray(all_points[used])
        again = np.zeros(len(used), bool)
        image = Image(points, numbers, ids, seen["descriptors"][used], used, status, again)
        if self.believed.repeat_s == 0.0:
            return image
        last = [self._last_s.get((frame.robot, i), -math.inf) for i in _listed(image)]
        kept = image.select(frame.stamp - np.array(last) >= self.believed.repeat_s)
        return dataclasses.replace(kept, again=used & ~kept.used)

    def note_counted(self, image: Image, frame: Frame) -> None:
        """Note when the landmarks of a Frame's image counted."""
        if self.believed.repeat_s > 0.0:
            self._last_s |= {(frame.robot, i): frame.stamp for i in _listed(image)}

    def passed(
        self, image: Image, landmarks: Ints, distances: Array, pose: Array
    ) -> NDArray[np.bool_]:
        """Which observations (K,) pass the gate.

        Parameters
        ----------
        landmarks
            (K,), -1 for those of new ids. These pass if the last sighting placed them, within the
            noise of both, where this one does.
        distances
            Squared Mahalanobis distance of each observation that has a landmark.
        pose
            (3,) believed pose of base_link in map.
        """
        kept = np.ones(len(landmarks), bool)
        kept[landmarks >= 0] = distances < self._gate
        for k in np.flatnonzero(landmarks < 0):
            point, name = image.points[k], _listed(image)[k]
            before = self._tentative.get(name)
            self._tentative[name] = self.camera.place(pose, point)
            kept[k] = False
            if before is not None:
                v, R = self.camera.innovation(self.camera.predict(pose, before)[0], point)
                kept[k] = v @ np.linalg.solve(2.0 * R, v) < self._gate
        return kept

    def known(self, image: Image) -> Ints:
        """Landmark (K,) of each id, -1 for new ones."""
        return np.array([self._landmark_of_id.get(i, -1) for i in _listed(image)], np.int64)

    def unlikeness(self, image: Image) -> Array:
        """-2 log of the likelihood ratio (K, N): same landmark against another, by descriptor.

        (K, 0) unless association is by descriptor.
        """
        if self.believed.association != "descriptor":
            return np.zeros((len(image.points), 0))
        require(
            not (image.descriptors.shape[1] == 0 < len(image.points)),
            f"{self._estimator}: observations without descriptors; set "
            "estimator.association=mahalanobis",
        )
        if len(self.origins) == 0:
            return np.zeros((len(image.points), 0))
        products = (image.descriptors @ self._descriptors.T).astype(np.float64)
        return np.asarray(image.descriptors.shape[1] * self._rho * (self._rho - 2.0 * products))

    def start(self, image: Image, rows: Ints | NDArray[np.bool_]) -> None:
        """Number the landmarks that these of the image's observations start."""
        n = len(self.origins)
        self.origins = np.concatenate([self.origins, image.numbers[rows]])
        if self.identified and image.ids is not None:
            self._landmark_of_id |= {i: n + k for k, i in enumerate(image.ids[rows].tolist())}
        if self.believed.association == "descriptor":
            fresh = image.descriptors[rows]
            self._descriptors = np.concatenate([self._descriptors, fresh]) if n else fresh

    def associations(self, image: Image, landmarks: Ints) -> Ints:
        """For each observation of an image, used or not, the one that started its landmark.

        `landmarks` (K,) are -1 for observations that start one; rejected observations get -1, and
        those that would count again too soon -2.
        """
        origins = np.where(image.again, -2, -1)
        old = landmarks >= 0
        origins[image.used] = image.numbers
        origins[np.flatnonzero(image.used)[old]] = self.origins[landmarks[old]]
        return origins

    def map(
        self, means: Array, covariances: Array, landmarks: Ints | slice
    ) -> dict[str, Array | Ints]:
        """`landmarks` (N, 3) and `landmark_covariances` (N, 3, 3), with `origins` and `ids` (N,).

        `ids` are the sensor's, and are there under known association only.
        """
        ids = {"ids": np.array(list(self._landmark_of_id), dtype=np.int64)}
        return {
            "landmarks": means,
            "landmark_covariances": covariances,
            "origins": self.origins[landmarks].copy(),
            **(ids if self.identified else {}),
        }


def _listed(image: Image) -> list[int]:
    """Ids of an image's observations."""
    ids: list[int] = [] if image.ids is None else image.ids.tolist()
    return ids
