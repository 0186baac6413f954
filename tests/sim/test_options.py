"""Options: bounds, messages that name the key, meanings, and methods that inherit them."""

import dataclasses
from typing import Annotated, Literal

import pytest
from pydantic import Field

from sim.errors import InputError, require
from sim.options import Count, NonNegative, Share, described, options


@options("estimator")
class Wheels:
    kr: NonNegative = 1e-4
    """Believed slip variance per metre, m."""


@options("estimator")
class Method(Wheels):
    q: float
    n: Count = 5
    how: Literal["a", "b"] = "a"
    share: Share | None = None
    """Share of
    something."""
    on: bool = False
    size: Annotated[int, Field(ge=1, le=10)] = 3

    def __post_init__(self):
        require(self.n != 7, "estimator.n is seven")


class Filter(Method):
    def reset(self):
        self._state = 3


def test_a_method_keeps_its_options_frozen_and_has_a_state():
    made = Filter(q=1)
    made.reset()
    assert (made.q, made.n, made._state) == (1.0, 5, 3)
    with pytest.raises(dataclasses.FrozenInstanceError):
        made.n = 3


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"n": 0}, "estimator.n must be a whole number, at least 1, got 0"),
        ({"n": True}, "estimator.n must be a whole number, at least 1, got True"),
        ({"n": 7}, "estimator.n is seven"),
        ({"kr": "x"}, "estimator.kr must be zero or a positive number, got 'x'"),
        ({"kr": float("nan")}, "estimator.kr must be zero or a positive number, got nan"),
        ({"how": "c"}, "estimator.how must be one of a, b, got 'c'"),
        ({"share": 2}, r"estimator.share must be a number in \[0, 1\], or null, got 2"),
        ({"on": 1}, "estimator.on must be true or false, got 1"),
        ({"size": 11}, "estimator.size must be a whole number from 1 to 10, got 11"),
        (
            {"nn": 3},
            "unknown key estimator.nn; did you mean estimator.n\\? known: estimator.n, .*",
        ),
    ],
)
def test_a_wrong_value_is_named(wrong, complaint):
    with pytest.raises(InputError, match=f"^{complaint}$"):
        Filter(**{"q": 1.0, **wrong})


def test_a_missing_one_is_named():
    with pytest.raises(InputError, match=r"^estimator\.q is missing$"):
        Filter()


def test_what_is_shown_of_options():
    shown = {option.name: option for option in described(Filter)}
    assert list(shown) == ["kr", "q", "n", "how", "share", "on", "size"]
    assert shown["kr"].meaning == "Believed slip variance per metre, m."
    assert shown["share"].meaning == "Share of something."
    assert (shown["n"].default, shown["q"].default) == (5, dataclasses.MISSING)


def test_functions_are_described_by_their_signature():
    def world(*, n: int = 3, rng=None):
        return n, rng

    assert [(o.name, o.default, o.accepts) for o in described(world)] == [
        ("n", 3, "a whole number"),
        ("rng", None, ""),
    ]


def test_a_subclass_may_have_a_constructor_of_its_own():
    class Mine(Filter):
        def __init__(self, how_much=3):
            super().__init__(q=how_much)

    assert [option.name for option in described(Mine)] == ["how_much"]
    assert Mine(how_much=2).q == 2.0
