"""Monte Carlo localization in a known map by a laser (the starting point of maximo2024, sec. 2.1).

Particles roll by the wheels, are weighted by a likelihood field, and are resampled. Their number
follows the spread of the belief: as many as the bins of pose that they fall into call for (KLD
sampling; Fox 2003).

Where in one hypothesis the robot is, all the beams say by a fit to the walls (see `wall_fit`).

The likelihood of a beam is bounded (see `likelihood_field`), so people and moved furniture, which
the map lacks, cannot outweigh the walls. It is wide while the belief is wide, and sharp after that.

The filter may be lost, and two ways back are offered. `rivals`: a set of particles drawn by a scan
over all the floor, and as many drawn from the belief, follow the same wheels and scans for a while;
if the best path of the rivals explains them better than the best of the defenders by a margin, the
rivals become the belief. People and what the map lacks count against both alike. `average`: when
scans fit worse than their long-term average, particles are injected over all the floor (augmented
MCL), drawn by the scan (sensor resetting). It takes people for being lost, and each of up to
`max_particles` injected costs `tries` poses to draw.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from estimators.base import Belief, LaserOptions, Prior
from estimators.gaussian import STILL, Gaussian, root
from estimators.laser.sweep import at_stamp
from estimators.on_a_map.bins import BinOptions, Bins
from estimators.on_a_map.likelihood_field import (
    FieldOptions,
    beam_ends,
    likelihood_field,
)
from estimators.on_a_map.wall_fit import WallFit
from estimators.particles import (
    Scheme,
    effective_sample_size,
    have_underflowed,
    normalize,
    resample,
)
from estimators.wheels import WheelOptions, WheelPrediction
from sim import se2
from sim.arrays import Array, Floats
from sim.compiled import njit
from sim.errors import require
from sim.options import Count, NonNegative, Positive, options
from sim.recording import Frame
from sim.worlds.grid import OccupancyGrid
from sim.worlds.world import World

Recovery = Literal["none", "average", "rivals"]

_BISECTIONS = 12
_ASKED = 32  # particles of which a scan that is not used is asked
_SAMPLED = 16  # one in so many poses tried on the floor decides by how much a scan counts there
_MOST_PARTICLES, _MOST_TRIES = 10_000_000, 100_000_000  # 0.2 and 2 GB of poses
_FARTHEST_M, _FARTHEST_RAD = 1.0, 0.5  # of what belongs to one hypothesis
_ONE_HYPOTHESIS = 0.9  # share of the weight from which on a scan is fitted in it


@options("estimator")
class MclOptions(WheelOptions, FieldOptions, BinOptions, LaserOptions):
    """Options of Monte Carlo localization."""

    min_particles: Count = 1000
    """Least number of particles."""
    max_particles: Annotated[int, Field(ge=1, le=_MOST_PARTICLES)] = 20_000
    """Greatest number of particles, with which it starts."""
    n_beams: Count = 60
    """Beams of each scan that are used, evenly spaced."""
    beam_power: Positive = 0.3
    """Each beam's likelihood is raised to this power, since neighbouring beams err together and
    particles are few for so sharp a likelihood; 1 for independent beams."""
    search_sigma_m: Positive = 0.2
    """The same while the belief calls for more than `min_particles`, and of poses drawn over the
    floor: a sharp likelihood would pass between the particles (Pfaff, Burgard, Fox 2006, Robust
    Monte-Carlo localization using adaptive likelihood models)."""
    fit_walls: bool = True
    """Answer by a fit of all beams to the walls in the heaviest hypothesis, rather than by the
    mean of its particles. The particles do not depend on it."""
    min_ess: NonNegative = 0.4
    """A scan counts for less when it would leave less than this share of the particles; below
    `ess_share`."""
    tries: Count = 100
    """Poses tried on the floor for each particle injected there by the scan."""
    update_distance_m: NonNegative = 0.2
    """Distance that the robot goes between scans that are used, m, or turns by the next."""
    update_turn_rad: NonNegative = 0.2
    """Angle that it turns between scans that are used, rad."""
    resampling: Scheme = "systematic"
    """Scheme of resampling: see `estimators.particles.resample`."""
    ess_share: NonNegative = 0.5
    """Particles are resampled when the effective sample size is below this share of them."""
    jitter_m: NonNegative = 0.01
    """Spread added to the place of each particle drawn, so that copies differ, m."""
    jitter_rad: NonNegative = 0.005
    """Spread added to the heading of each particle drawn, rad."""
    recovery: Recovery = "rivals"
    """Recovery from being lost: by the `average` of the fit over time, by `rivals` that see the
    same scans, or `none`."""
    alpha_slow: NonNegative = 0.01
    """Of `average`: rate of the long average of a beam's likelihood; 0 for no recovery."""
    alpha_fast: NonNegative = 0.2
    """Of `average`: rate of the short average."""
    recovery_ratio: NonNegative = 0.9
    """Of `average`: particles are injected when the short average falls below this share of the
    long one."""
    n_rivals: Count = 2000
    """Of `rivals`: their number."""
    rival_scans: Count = 15
    """Of `rivals`: scans after which they are judged."""
    rival_margin: NonNegative = 0.2
    """Of `rivals`: how much greater the mean log likelihood of a beam must be along their best
    path."""

    def __post_init__(self) -> None:
        most = max(self.max_particles, self.n_rivals)
        require(
            most * self.tries <= _MOST_TRIES,
            f"estimator.max_particles={self.max_particles}, n_rivals={self.n_rivals} and "
            f"tries={self.tries} draw {most * self.tries} poses at once; at most "
            f"{_MOST_TRIES} are drawn",
        )
        require(
            self.min_particles <= self.max_particles,
            f"estimator.min_particles={self.min_particles} is above "
            f"max_particles={self.max_particles}",
        )
        require(
            self.min_ess < self.ess_share,
            f"estimator.min_ess={self.min_ess} is not below ess_share={self.ess_share}",
        )


class Mcl(MclOptions):
    """Monte Carlo localization with a likelihood field of a world's walls or an occupancy grid.

    Notes
    -----
    `amcl_alphas` converts kr and kl for AMCL.

    The defaults find the robot anywhere and keep it among people; tempering and jitter make the
    particles spread wider than their mean errs. The belief is the fit of all beams to the walls,
    where there is one hypothesis and the fit holds, with its covariance, else that of the
    particles. Where the walls are exact, fits are joined by the wheels. Particles that know their
    error, without the fit, want beam_power=1, min_ess=0, sigma_m of 0.05, and no jitter.

    Without a start pose the particles are drawn by the first scan, and later ones are injected by
    the current one: along a corridor, where long beams fix the heading closely, a uniform draw
    would leave none near the truth.

    The particles' mean is that of the hypothesis (within 1 m and 0.5 rad) of greatest weight; the
    covariance is that of all of them about it, so it shows whether there are others. Extras, of
    the last scan used: `particles` (M, 3), `log_weights` (M,), `ess`, `hypothesis_weight`,
    `fit`, the likelihood of a beam at the best particle, `lost`, 1 less the product of these two
    (of a scan that was not used, too), and `injected`, the number of particles injected, those of
    rivals that became the belief included; `status` when a scan saw nothing.
    """

    needs = frozenset({"laser", "map"})
    maps = (World, OccupancyGrid)
    global_or_grid = True

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Draw particles from the prior's pose, or from all the floor if there is none."""
        self._laser, self._rng = prior.require_laser(self.laser, "mcl"), rng
        require(
            isinstance(prior.map, self.maps),
            "mcl needs a map of walls; set prior.map=world, or to a grid's .yaml",
        )
        self._wheels = WheelPrediction(self, prior.robot.track_m)
        self._field = likelihood_field(prior.map, self._laser, self)
        wide = FieldOptions(sigma_m=self.search_sigma_m, max_loss=self.max_loss, cell_m=self.cell_m)
        self._search_field = likelihood_field(prior.map, self._laser, wide)
        self._bins = Bins(self._field, self)
        self._off_map = prior.mean is not None and not self._field.holds(prior.mean)
        start, self._everywhere = prior.start, prior.start is None
        if start is None:
            self._poses = self._field.draw(self.max_particles, rng)
        else:
            normals = rng.standard_normal((self.max_particles, 3))
            self._poses = start.mean + normals @ root(start.covariance).T
            self._poses[:, 2] = se2.wrap(self._poses[:, 2])
        self._log_weights = np.zeros(len(self._poses))
        self._contest: Array | None = None  # (2, n_rivals, 3) poses of defenders and rivals
        self._motion = STILL  # since the last scan used
        # A beam errs along itself by the laser's noise, and by half a cell either way
        variance = self._laser.sigma_range_m**2 + self.cell_m**2 / 6.0
        self._slow = self._fast = math.exp(-0.5 * variance / self.sigma_m**2)
        self._seen = False
        self._wall_fit = WallFit(self._field, prior.map, self._laser) if self.fit_walls else None
        self._fitted: Gaussian | None = None
        self._extras: dict[str, Any] = {}
        self._belief = self._summed_up()

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; with a scan from a new place, weight and resample."""
        rolled = self._wheels.predict(frame)
        self._motion = self._motion.then(rolled)
        extras: dict[str, Any] = {"status": "start off the map"} if self._off_map else {}
        self._off_map = False
        scan = frame.readings.get(self.laser)
        is_due = self._is_due()
        if scan is not None:
            ranges_m, bearings_rad = at_stamp(
                scan["ranges_m"], self._laser, rolled.mean, frame.duration_s
            )
            ends = beam_ends(ranges_m, self._laser, self.n_beams, bearings_rad)
        if scan is not None and not is_due and ends.shape[1]:
            extras["lost"] = self._doubt(ends)
        if scan is not None and is_due:
            self._move()
            self._seen = True
            if ends.shape[1] == 0:
                extras["status"] = "scan without returns"
                self._belief = self._summed_up()
            else:
                self._weigh(ends)
        now = self._belief.then(self._motion)
        if self._wall_fit is not None:
            self._wall_fit.roll(rolled)
        if scan is not None:
            slip = rolled.covariance / max(frame.duration_s, 1e-9)
            self._fitted = self._fit(now, ranges_m, bearings_rad, slip, learn=is_due)
        elif self._fitted is not None:
            self._fitted = self._fitted.then(rolled)
        said = self._fitted or now
        symmetric = (said.covariance + said.covariance.T) / 2.0
        return Belief(said.mean.copy(), symmetric, self._extras | extras)

    def _fit(
        self, now: Gaussian, ranges_m: Array, bearings_rad: Array, slip: Array, *, learn: bool
    ) -> Gaussian | None:
        """Fit a scan to the walls, if there is one hypothesis; None if it does not fit."""
        if self._wall_fit is None or self._extras["hypothesis_weight"] < _ONE_HYPOTHESIS:
            return None
        return self._wall_fit.fit(now, ranges_m, bearings_rad, slip, learn=learn)

    def _is_due(self) -> bool:
        """Whether the robot has come far enough since the last scan used."""
        x, y, turn = self._motion.mean
        far = math.hypot(x, y) >= self.update_distance_m or abs(turn) >= self.update_turn_rad
        return far or not self._seen

    def _doubt(self, ends: Floats) -> float:
        """How ill a scan fits that is not used: as `lost`, at some of the particles.

        Wheels that stand or are lifted while the robot goes on never bring it to a new place.
        """
        few = self._poses[:: max(1, len(self._poses) // _ASKED)]
        of_scan = self._field.log_likelihood(se2.compose(few, self._motion.mean), ends)
        fit = math.exp(float(np.max(of_scan)) / ends.shape[1])
        return 1.0 - fit * float(self._extras["hypothesis_weight"])

    def _move(self) -> None:
        """Draw the motion since the last scan used, for each particle."""
        normals = self._rng.standard_normal(self._poses.shape)
        self._poses = self._poses.copy()  # the last Belief keeps its own
        by_normals = root(self._motion.covariance)
        _move(self._poses, self._motion.mean, by_normals, normals)
        for poses in () if self._contest is None else self._contest:
            _move(poses, self._motion.mean, by_normals, self._rng.standard_normal(poses.shape))
        self._motion = STILL

    def _weigh(self, ends: Floats) -> None:
        """Weight by one scan, sum up the belief, and resample if that is due."""
        if self._everywhere:
            self._poses = self._drawn_by_scan(self.max_particles, ends)
            self._everywhere = False
            self._belief = self._summed_up()
            return
        narrow = self._bins.count_particles(self._poses) <= self.min_particles
        field = self._field if narrow else self._search_field
        of_scan = field.log_likelihood(self._poses, ends)
        self._log_weights = self._weighed(of_scan)
        self._belief = self._summed_up()
        if self.recovery == "rivals" and self._yielded(ends):
            return
        share = self._injected_share(of_scan, ends.shape[1])
        if share > 0.0 or self._extras["ess"] < self.ess_share * len(self._poses):
            self._draw(share, ends)

    def _weighed(self, of_scan: Array) -> Array:
        """Log weights (M,) with a scan of log likelihoods (M,), counted as far as they bear it."""
        least = min(self.min_ess * len(of_scan), effective_sample_size(self._log_weights))
        power = self._power(self._log_weights, of_scan, least)
        weights = self._log_weights + power * of_scan
        return np.zeros(len(weights)) if have_underflowed(weights) else weights - np.max(weights)

    def _power(self, log_weights: Array, of_scan: Array, least: float) -> float:
        """Power of a scan's likelihood: `beam_power`, or what leaves an effective size of `least`.

        The effective sample size falls as the power grows, so the power is found by bisection.
        """
        low, high = 0.0, self.beam_power
        if effective_sample_size(log_weights + high * of_scan) >= least:
            return high
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2.0
            poor = effective_sample_size(log_weights + middle * of_scan) < least
            low, high = (low, middle) if poor else (middle, high)
        return low

    def _injected_share(self, of_scan: Array, n_beams: int) -> float:
        """Share of particles to inject: the short average of the fit against the long one.

        The fit is the geometric mean likelihood of a beam at the particle that fits best: the mean
        over the particles, as in augmented MCL, is poor for any belief that is still spread.
        """
        fit = math.exp(float(np.max(of_scan)) / n_beams)
        self._extras["fit"] = fit
        self._extras["lost"] = 1.0 - fit * self._extras["hypothesis_weight"]
        if self.recovery != "average" or self.alpha_slow == 0.0:
            return 0.0
        self._slow += self.alpha_slow * (fit - self._slow)
        self._fast += self.alpha_fast * (fit - self._fast)
        return max(0.0, 1.0 - self._fast / (self.recovery_ratio * self._slow))

    def _yielded(self, ends: Floats) -> bool:
        """Weight rivals and defenders by the scan; return whether the rivals took over.

        Both are as many, and are resampled alike at every scan: a wide cloud explains a scan worse
        than a narrow one at the same place. The scan that draws them does not count.
        """
        n = self.n_rivals
        if self._contest is None:
            defenders = self._poses[resample(self._log_weights, n, self._rng, self.resampling)]
            rivals = self._drawn_by_scan(n, ends)
            self._contest = np.stack([self._jittered(defenders), rivals])
            self._explained, self._n_explained, self._n_contested = np.zeros((2, n)), 0, 0
            return False
        for side in (0, 1):
            of_scan = self._search_field.log_likelihood(self._contest[side], ends)
            power = self._power(np.zeros(n), of_scan, self.min_ess * n)
            drawn = resample(power * of_scan, n, self._rng, self.resampling)
            poses = self._contest[side][drawn]
            sharp = self._field.log_likelihood(poses, ends)
            self._explained[side] = self._explained[side][drawn] + sharp
            self._contest[side] = self._jittered(poses)
        self._n_explained += ends.shape[1]
        self._n_contested += 1
        if self._n_contested < self.rival_scans:
            return False
        defended, gained = self._explained.max(axis=1) / self._n_explained
        rivals, self._contest = self._contest[1], None
        if gained - defended <= self.rival_margin:
            return False
        self._poses, self._log_weights = rivals, np.zeros(n)
        self._belief = self._summed_up()
        self._extras["injected"] = n
        return True

    def _jittered(self, poses: Array) -> Array:
        """Poses (M, 3), each moved a little, so that copies differ."""
        jitter = self._rng.standard_normal(poses.shape)
        moved: Array = poses + jitter * [self.jitter_m, self.jitter_m, self.jitter_rad]
        return moved

    def _drawn_by_scan(self, n: int, ends: Floats) -> Array:
        """Poses (n, 3) over all the floor, drawn by how well the scan fits there."""
        tries = self._field.draw(n * self.tries, self._rng)
        of_scan = self._search_field.log_likelihood(tries, ends)
        sample = of_scan[:: min(self.tries, _SAMPLED)]
        least = self.min_ess * n * len(sample) / len(tries)
        power = self._power(np.zeros(len(sample)), sample, least)
        return tries[resample(power * of_scan, n, self._rng, self.resampling)]

    def _draw(self, injected_share: float, ends: Floats) -> None:
        """Resample to as many particles as the bins they fall into call for, and inject others."""
        n, needed = 0, max(self.min_particles, min(len(self._poses), self.max_particles) // 4)
        poses, n_injected = self._poses, 0
        while n < needed:
            n = needed
            n_injected = int(self._rng.binomial(n, injected_share))
            drawn = resample(self._log_weights, n - n_injected, self._rng, self.resampling)
            poses = self._poses[drawn]
            if n_injected > 0:
                poses = np.concatenate([poses, self._drawn_by_scan(n_injected, ends)])
            needed = min(
                max(self._bins.count_particles(poses), self.min_particles), self.max_particles
            )
        self._poses, self._log_weights = self._jittered(poses), np.zeros(n)
        self._extras["injected"] = n_injected

    def _summed_up(self) -> Gaussian:
        """Belief of the weighted particles, and its extras."""
        weights = normalize(self._log_weights)
        poses = self._poses
        bins = self._bins.number(poses)
        heaviest = bins == np.argmax(np.bincount(bins, weights))
        mean = weights[heaviest] @ poses[heaviest] / weights[heaviest].sum()
        for _ in range(2):
            off = se2.difference(poses, mean)
            near = np.hypot(off[:, 0], off[:, 1]) < _FARTHEST_M
            near &= np.abs(off[:, 2]) < _FARTHEST_RAD
            held = float(weights[near].sum())
            if held > 0.0:
                mean = mean + weights[near] @ off[near] / held
        off = se2.difference(poses, mean)
        covariance = (off * weights[:, None]).T @ off
        mean[2] = se2.wrap(mean[2])
        self._extras = {
            "particles": poses,
            "log_weights": self._log_weights,
            "ess": effective_sample_size(self._log_weights),
            "hypothesis_weight": held,
            "lost": self._extras.get("lost", float(self._everywhere)),
            "injected": 0,
        }
        return Gaussian(mean, (covariance + covariance.T) / 2.0)


def amcl_alphas(
    kr: float, kl: float, track_m: float, distance_m: float, turn_rad: float
) -> tuple[float, float, float, float]:
    """AMCL's alpha1 to alpha4 (differential model) that have the variances of kr and kl.

    Slip grows with the distance, Var = k |ds|; AMCL's variances grow with its square, Var =
    alpha ds^2. So they agree at one length of update only, the one given: a straight of
    `distance_m` (alpha2, alpha3) and a turn on the spot of `turn_rad` (alpha1, alpha4).

    Parameters
    ----------
    distance_m, turn_rad
        AMCL's `update_min_d` and `update_min_a`.

    Returns
    -------
    tuple
        alpha1 (turn by turn), alpha2 (turn by distance, rad^2/m^2), alpha3 (distance by
        distance), alpha4 (distance by turn, m^2/rad^2).
    """
    both = kr + kl
    return (
        both / (2.0 * track_m * turn_rad),
        both / (2.0 * track_m**2 * distance_m),  # two of AMCL's turns share the variance
        both / (4.0 * distance_m),
        both * track_m / (8.0 * turn_rad),
    )


@njit()
def _move(poses: Array, increment: Array, root: Array, normals: Array) -> None:
    """Compose poses (M, 3) with the increment (3,) + root (3, 3) normals (M, 3), in place."""
    for m in range(len(poses)):
        a, b, c = normals[m, 0], normals[m, 1], normals[m, 2]
        x = increment[0] + root[0, 0] * a + root[0, 1] * b + root[0, 2] * c
        y = increment[1] + root[1, 0] * a + root[1, 1] * b + root[1, 2] * c
        turn = increment[2] + root[2, 0] * a + root[2, 1] * b + root[2, 2] * c
        cos, sin = math.cos(poses[m, 2]), math.sin(poses[m, 2])
        poses[m, 0] += cos * x - sin * y
        poses[m, 1] += sin * x + cos * y
        heading = poses[m, 2] + turn
        poses[m, 2] = heading - 2.0 * math.pi * math.ceil((heading - math.pi) / (2.0 * math.pi))
