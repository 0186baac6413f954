"""A robot of another kind and another law of slip, each a class that `_target_` names."""

import numpy as np
import pytest

from sim.errors import InputError
from sim.options import Positive, options
from sim.robot.base import robot_from_config
from sim.robot.drive import DifferentialDrive
from sim.robot.kinematic import run_batch
from sim.routes.route import OpenLoop
from sim.sensors import Encoder
from sim.simulate import Member, record
from sim.worlds.world import World

EMPTY = World("empty", np.zeros((0, 4)), np.zeros((0, 2)))
SIZES = {"wheel_radius_m": 0.1, "track_m": 0.4}


@options("robot")
class SkidSteer(DifferentialDrive):
    """Four wheels that skid as they turn: the body turns as if the track were wider."""

    widening: Positive = 1.5

    def start_slip(self, dt_s, rng):
        return Skidding(super().start_slip(dt_s, rng), self.widening)


class Skidding:
    """The wheels skid across: what they roll against each other does not all turn the body."""

    def __init__(self, along, widening):
        self._along, self._widening = along, widening

    @property
    def correction_mps(self):
        return self._along.correction_mps

    def advance(self, rolling_m):
        right_m, left_m = rolling_m
        middle_m, half_m = (right_m + left_m) / 2, (right_m - left_m) / 2 * self._widening
        return self._along.advance((middle_m + half_m, middle_m - half_m))


@options("robot")
class OnIce(DifferentialDrive):
    """A robot whose right wheel spins every other tick."""

    def start_slip(self, dt_s, rng):
        return Ice()


class Ice:
    """Encoders that count half as much again, every other tick, on the right."""

    correction_mps = 0.0, 0.0

    def __init__(self):
        self._tick = 0

    def advance(self, rolling_m):
        self._tick += 1
        right_m, left_m = rolling_m
        return (1.5 if self._tick % 2 else 1.0) * right_m, left_m


def driven(robot, segment):
    streams = {axis: np.random.default_rng(i) for i, axis in enumerate(("slip", "sensors"))}
    route = OpenLoop(segments=(segment,))
    member = Member(robot, {"encoder": Encoder()}, route, streams)
    return record(EMPTY, member, physics="kinematic", rays="exact")


def named(kind, **settings):
    return robot_from_config({"_target_": f"{__name__}.{kind}", **SIZES, **settings})


@pytest.mark.parametrize("widening", [1.0, 1.5])
def test_a_skid_steer_robot(widening):
    recording = driven(named("SkidSteer", widening=widening), (0.0, 0.5, 4.0))
    turned = recording.truth.poses[-1, 2]
    right_m, left_m = recording.wheels.position_m[-1]
    assert turned == pytest.approx(2.0)
    assert (right_m - left_m) / 0.4 == pytest.approx(2.0 * widening)


def test_another_law_of_slip():
    recording = driven(named("OnIce"), (0.5, 0.0, 2.0))
    assert recording.wheels.position_m[-1] == pytest.approx([1.25, 1.0], rel=1e-3)
    route = OpenLoop(segments=((0.5, 0.0, 2.0),))
    with pytest.raises(InputError, match="OnIce has its own; simulate its runs one by one"):
        run_batch(named("OnIce"), route, 2, np.random.default_rng(0))


def test_a_robot_is_what_the_simulator_asks_for():
    assert type(robot_from_config(SIZES)) is DifferentialDrive
    with pytest.raises(
        InputError, match=r"^robot\._target_=sim\.sensors\.base\.Mount has no wheel_r"
    ):
        robot_from_config({"_target_": "sim.sensors.base.Mount"})
    with pytest.raises(InputError, match="must be a dataclass"):
        robot_from_config({"_target_": "sim.errors.InputError"})
    with pytest.raises(
        InputError,
        match=r"^unknown key robot\.track; did you mean robot\.track_m\? known: robot\.track_m",
    ):
        robot_from_config({**SIZES, "track": 1})
