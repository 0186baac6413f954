"""What a sensor of one's own may do wrong, each named in one line."""

import dataclasses

import numpy as np
import pytest

from sim.errors import InputError
from sim.sensors import (
    Field,
    Mount,
    sensors_from_config,
)
from tests.sim.sensors.test_own_sensor import drive


@dataclasses.dataclass(frozen=True)
class Odd:
    """A sensor whose probe does what `does` says."""

    does: str = "nothing"
    rate_hz: float = 10.0

    @property
    def schema(self):
        return {"a": Field("m", shape=(3,)), "n": Field("", "u1")}

    def start(self, rng):
        buffer = np.zeros(3)
        if self.does == "no probe":
            return None

        def probe(view):
            if self.does == "write":
                view.pose[:2] += 1.0
            if self.does == "divide":
                return {"a": 1 // 0, "n": 0}
            if self.does == "exit":
                raise SystemExit(0)
            buffer[:] = view.stamp
            wrong = {"none": [None] * 3, "complex": 1j * buffer}
            count = {"large": 1000, "part": 0.5}.get(self.does, 7)
            return Unprinted({"a": wrong.get(self.does, buffer), "n": count})

        return probe


class Unprinted(dict):
    """A sound reading is never made into text, which takes a hundred times as long as the rest."""

    def __repr__(self):
        raise AssertionError("printed")


def test_a_reading_is_copied_when_it_is_taken():
    log = drive({"odd": Odd()}).log("odd")
    assert log["a"][:, 0].tolist() == log.stamps.tolist()
    assert log["n"].tolist() == [7] * len(log.stamps)


@pytest.mark.parametrize(
    ("does", "message"),
    [
        ("write", r"sensors\.odd raised ValueError: .*read-only.*\(test_wrong_sensor\.py:\d+\)"),
        ("divide", r"sensors\.odd raised ZeroDivisionError"),
        ("exit", r"sensors\.odd raised SystemExit"),
        ("no probe", r"sensors\.odd: start must return a function"),
        ("none", r"sensors\.odd\.a must hold numbers, got object"),
        ("complex", r"sensors\.odd\.a must hold numbers, got complex"),
        ("large", r"sensors\.odd\.n must lie in \[0, 255\]"),
        ("part", r"sensors\.odd\.n must hold whole numbers"),
    ],
)
def test_what_a_probe_does_wrong_is_one_line(does, message):
    with pytest.raises(InputError, match=message) as caught:
        drive({"odd": Odd(does)})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf"), "fast"])
def test_a_rate_is_a_positive_number(rate_hz):
    with pytest.raises(InputError, match=r"sensors\.odd\.rate_hz must be a positive number"):
        drive({"odd": Odd(rate_hz=rate_hz)})


@pytest.mark.parametrize("shape", [3, (-1,), (2.5,), [3]])
def test_a_shape_is_a_tuple_of_sizes(shape):
    with pytest.raises(InputError, match="shape must be a tuple"):
        Field("m", shape=shape)


@pytest.mark.parametrize("name", ["wheels", "commands", "truth"])
def test_names_of_what_a_recording_holds_besides_are_taken(name):
    with pytest.raises(InputError, match="none of wheels, commands, truth"):
        sensors_from_config({name: {"_target_": "sim.sensors.encoder.Encoder"}})


@pytest.mark.parametrize("key", ["x_m", "y_m", "z_m", "yaw_rad"])
@pytest.mark.parametrize("value", [1e300, -101.0, float("nan")])
def test_a_mount_is_on_the_robot(key, value):
    with pytest.raises(InputError, match=rf"sensors\.mount\.{key} must be a number from -"):
        Mount(**{key: value})
