"""What a log writes where nothing was seen is decided from the log itself."""

import numpy as np
import pytest

from experiments.viewing.describe import describe
from sim.formats.assemble import seen_ranges
from sim.formats.carmen import read_carmen, to_recording
from sim.formats.text import split_words

N_SCANS, N_BEAMS = 60, 90


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def hall(rng, farthest_m=12.0):
    """Ranges (M, n) of a hall, logged in centimetres, and which of the beams see nothing."""
    angles = np.linspace(-1.5, 1.5, N_BEAMS)
    walls = np.minimum(farthest_m, 2.5 / np.maximum(np.abs(np.sin(angles)), 1e-3))
    x = np.linspace(0.0, 0.3 * farthest_m, N_SCANS)
    ranges = walls - x[:, None] * np.cos(angles) + 0.02 * rng.standard_normal((N_SCANS, N_BEAMS))
    return np.round(np.maximum(ranges, 0.5), 2), rng.random(ranges.shape) < 0.03


@pytest.mark.parametrize("value", [8.19, 50.0, 51.1, 81.83, 0.0, np.nan])
def test_planted_value_is_as_beams_removed_by_hand(value, rng):
    ranges, unseen = hall(rng, farthest_m=7.5)
    notes = {}
    decided, max_range_m = seen_ranges(np.where(unseen, value, ranges), 80.0, notes)
    by_hand = np.where(unseen, np.inf, ranges).astype(np.float32)
    np.testing.assert_array_equal(decided, by_hand)
    assert f"{100 * unseen.mean():.2g} % of beams" in notes["no_return"]
    assert max_range_m == (value if 0.0 < value < 80.0 else 80.0)


def test_value_among_the_walls(rng):
    """A log of a longer range that writes 8.19 loses those readings and no others."""
    ranges, unseen = hall(rng, farthest_m=25.0)
    decided, max_range_m = seen_ranges(np.where(unseen, 8.19, ranges), 80.0, {})
    np.testing.assert_array_equal(np.isinf(decided), unseen | (ranges == 8.19))
    assert max_range_m == 80.0


def test_codes_next_to_each_other(rng):
    ranges, unseen = hall(rng)
    codes = rng.choice([81.83, 81.87, 81.91], ranges.shape)
    decided, _ = seen_ranges(np.where(unseen, codes, ranges), 100.0, {})
    np.testing.assert_array_equal(np.isinf(decided), unseen)


def test_walls_stay(rng):
    """Not even a wall that a resting robot sees all the time stands for nothing seen."""
    ranges, _ = hall(rng)
    resting = np.round(ranges[:1] + 0.01 * rng.standard_normal((N_SCANS, N_BEAMS)), 2)
    for scans in (ranges, resting, np.repeat(ranges[:1], N_SCANS, axis=0)):
        notes = {}
        assert np.isfinite(seen_ranges(scans, 80.0, notes)[0]).all()
        assert notes == {}


def test_log_says_it(rng):
    ranges, unseen = hall(rng)
    lines = []
    for i, scan in enumerate(np.where(unseen, 51.1, ranges)):
        numbers, x = " ".join(map(str, scan)), 0.1 * i
        lines.append(f"ODOM {x} 0 0 0 0 0 {10 + i} host 0")
        lines.append(f"FLASER {N_BEAMS} {numbers} {x} 0 0 {x} 0 0 {10.5 + i} host 0")
    log = read_carmen(split_words("\n".join(lines).encode(), "log"))
    recording = to_recording(log)
    np.testing.assert_array_equal(np.isinf(recording.log("laser")["ranges_m"]), unseen)
    assert "no return: 51.1 m and beyond (" in describe(recording)
