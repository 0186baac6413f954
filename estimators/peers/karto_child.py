"""The process of `karto.py`: JSON lines in and out (docs/programs.md), scans to Karto's matcher."""

import json
import math
import sys
from collections import deque
from typing import Any

Pose = tuple[float, float, float]


def compose(a: Pose, b: Pose) -> Pose:
    """T_a_c of T_a_b and T_b_c."""
    cos, sin = math.cos(a[2]), math.sin(a[2])
    heading = math.remainder(a[2] + b[2], 2.0 * math.pi)
    return a[0] + cos * b[0] - sin * b[1], a[1] + sin * b[0] + cos * b[1], heading


def inverse(a: Pose) -> Pose:
    """T_b_a of T_a_b."""
    cos, sin = math.cos(a[2]), math.sin(a[2])
    return -cos * a[0] - sin * a[1], sin * a[0] - cos * a[1], -a[2]


def rolled(right_m: float, left_m: float, track_m: float) -> Pose:
    """Motion along an arc."""
    turn, way = (right_m - left_m) / track_m, (right_m + left_m) / 2.0
    chord = way * (math.sin(turn / 2.0) / (turn / 2.0) if abs(turn) > 1e-9 else 1.0)
    return chord * math.cos(turn / 2.0), chord * math.sin(turn / 2.0), turn


class Mapper:
    """Matches each scan that is far enough from the last one against the chain of those before."""

    def __init__(self, given: dict[str, Any], told: dict[str, Any]) -> None:
        import karto_scanmatcher as karto  # type: ignore[import-not-found,unused-ignore]

        self.karto, self.given, self.track_m = karto, given, told["robot"]["track_m"]
        laser = told["sensors"][given["laser"]]
        mount, n, fov = laser["mount"], laser["n_beams"], laser["fov_rad"]
        self.mount: Pose = mount["x_m"], mount["y_m"], mount["yaw_rad"]
        step = fov / (n if fov > 2.0 * math.pi - 1e-6 else n - 1)
        most = min(laser["max_range_m"], given["max_range_m"])
        angles = -fov / 2.0, -fov / 2.0 + step * (n - 1), step
        self.config = karto.LaserScanConfig(*angles, laser["min_range_m"], most, most, "laser")
        match = karto.ScanMatcherConfig()
        match.search_size, match.resolution = given["search_size_m"], given["resolution_m"]
        match.smear_deviation, match.range_threshold = given["smear_m"], most
        match.distance_variance_penalty = given["distance_penalty"] ** 2
        match.angle_variance_penalty = given["angle_penalty"] ** 2
        match.minimum_distance_penalty = given["minimum_distance_penalty"]
        match.minimum_angle_penalty = given["minimum_angle_penalty"]
        match.coarse_search_angle_offset = given["coarse_offset_rad"]
        match.coarse_angle_resolution = given["coarse_step_rad"]
        match.fine_search_angle_resolution = given["fine_step_rad"]
        match.use_response_expansion = True
        self.matcher = karto.Wrapper(match)
        self.chain: deque[Any] = deque(maxlen=given["buffer_size"])
        self.pose: Pose = tuple(told["prior"]["mean"])
        self.since: Pose = (0.0, 0.0, 0.0)  # the last scan, by the wheels
        self.stamp = -math.inf

    def step(self, frame: dict[str, Any]) -> Pose:
        """Pose of the robot after a Frame."""
        right_m, left_m = frame["wheel_increments_m"]
        self.since = compose(self.since, rolled(right_m, left_m, self.track_m))
        here = compose(self.pose, self.since)
        reading = frame["readings"].get(self.given["laser"])
        if reading is None or not self.is_far(frame["stamp"]):
            return here
        karto = self.karto
        ranges = [0.0 if r is None else r for r in reading["ranges_m"]]  # below the least: left out
        at = karto.Pose2(*compose(here, self.mount))
        scan = karto.LocalizedRangeScan(
            self.config, ranges, at, at, len(self.chain), frame["stamp"]
        )
        if self.chain:
            best = self.matcher.match_scan(scan, list(self.chain), True, True).best_pose
            scan.corrected_pose = best
            here = compose((best.x, best.y, best.yaw), inverse(self.mount))
        self.chain.append(scan)
        while self.reach_m() > self.given["buffer_distance_m"]:
            self.chain.popleft()
        self.pose, self.since, self.stamp = here, (0.0, 0.0, 0.0), frame["stamp"]
        return here

    def is_far(self, stamp: float) -> bool:
        """Whether a scan at this time is matched."""
        given, (x, y, turn) = self.given, self.since
        moved = math.hypot(x, y) >= given["minimum_travel_m"]
        moved |= abs(turn) >= given["minimum_turn_rad"]
        waited: bool = stamp - self.stamp >= given["minimum_interval_s"] - 1e-9
        return not self.chain or (moved and waited)

    def reach_m(self) -> float:
        """Distance of the first scan of the chain from the last."""
        first, last = self.chain[0].corrected_pose, self.chain[-1].corrected_pose
        return math.hypot(first.x - last.x, first.y - last.y)


def main() -> None:
    """Answer each line."""
    mapper: Mapper | None = None
    for line in sys.stdin:
        message, answer = json.loads(line), {}
        if message["type"] == "reset":
            mapper = Mapper(json.loads(sys.argv[1]), message)
        elif message["type"] == "frame" and mapper is not None:
            answer = {"mean": mapper.step(message)}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
