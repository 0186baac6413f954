"""An estimator that fuses the wheels, any number of lasers, and the beacon."""

import numpy as np

from estimators.base import Belief
from estimators.gaussian import STILL, Gaussian, update, wrap
from estimators.laser.scan_matching import MatcherOptions, ScanMatcher
from estimators.wheels import WheelOptions, WheelPrediction
from sim.sensors import sensor_of


class Fused:
    """A Kalman filter of the pose, which rolls by the wheels between scans.

    It takes successive registrations to err independently, though they share a scan.
    """

    needs = frozenset({"beacon"})

    def __init__(self, lasers=("laser",), beacon="beacon", kr=1e-4, kl=1e-4):
        self.lasers, self.beacon = list(lasers), beacon
        self.wheels = WheelOptions(kr=kr, kl=kl)
        self.matcher = ScanMatcher(MatcherOptions())

    def reset(self, prior, rng):
        """Start from the prior's pose."""
        self.belief, self.rng = prior.require_start("fused"), rng
        self.sensors = {name: prior.require_laser(name, "fused") for name in self.lasers}
        beacon = sensor_of(prior.sensors, self.beacon)
        self.R = (beacon.sigma_m**2 + beacon.wander_m**2) * np.eye(2)
        self._wheels = WheelPrediction(self.wheels, prior.robot.track_m)
        self.rolled, self.scans = STILL, {}  # since the last scans

    def step(self, frame):
        """Predict by the wheels; correct by each scan, then by the beacon."""
        self.rolled = self.rolled.then(self._wheels.predict(frame))
        scanned = [name for name in self.lasers if name in frame.readings]
        for name in scanned:
            self.register(name, frame.readings[name]["ranges_m"])
        if scanned:
            self.belief, self.rolled = self.belief.then(self.rolled), STILL
        now = self.belief.then(self.rolled)
        if self.beacon in frame.readings:
            off = frame.readings[self.beacon]["position_m"] - now.mean[:2]
            now = Gaussian(*update(now.mean, now.covariance, off, np.eye(2, 3), self.R))
            self.belief, self.rolled = now, STILL
            if not scanned:
                self.scans.clear()  # they were taken elsewhere
        return Belief(now.mean, now.covariance)

    def register(self, name, ranges_m):
        """Correct the motion since the last scans by one laser."""
        laser, rolled = self.sensors[name], self.rolled
        scan, last = self.matcher.prepare(ranges_m, laser), self.scans.get(name)
        if scan is not None and last is not None:
            match = self.matcher.match(scan, last, rolled, laser, self.rng)
            off, H = match.motion.mean - rolled.mean, match.held
            off[2] = wrap(off[2])
            if not match.failed:
                R = H @ match.motion.covariance @ H.T
                self.rolled = Gaussian(*update(rolled.mean, rolled.covariance, H @ off, H, R))
        self.scans[name] = scan
