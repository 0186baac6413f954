import json
from pathlib import Path

import numpy as np
import pytest

from experiments.calibration.logs import calibrate_wheels, slip_of_turns
from sim import se2
from sim.errors import InputError
from sim.formats.khepera import parse_khepera, read_khepera, to_recording
from sim.robot.arc import arc_increment

DATA = Path(__file__).resolve().parents[4] / "shared/data/censi_khepera_calib"
ARCHIVE = DATA / "khepera_l90_lmov.tar.xz"
needs_data = pytest.mark.skipif(not ARCHIVE.exists(), reason="the Khepera log is not here")


def tuples(rng, n=1500, k=(2e-6, 1e-6), diameters=(0.0414, 0.0410), axle=0.088, scan_noise=0.0):
    """Text of a log whose wheels and laser are known; commands last 25 intervals."""
    laser = np.array([-0.01, 0.02, -1.5])
    speed = np.repeat(rng.choice([-0.5, 0.0, 0.5], size=(n // 25, 2)), 25, axis=0)
    ground = speed * 0.8 * np.array(diameters) / 2.0
    encoder = ground + np.sqrt(np.abs(ground) * k) * rng.standard_normal(ground.shape)
    motion = arc_increment(ground, axle)
    lasers = np.broadcast_to(laser, motion.shape)
    seen = se2.compose(se2.inverse(laser), se2.compose(motion, lasers))
    seen += np.array([2e-4, 2e-4, scan_noise]) * rng.standard_normal(seen.shape)
    phi = encoder / (0.8 * np.array(diameters) / 2.0)
    entries = [
        {"T": 0.8, "phi_l": p[1], "phi_r": p[0], "sm": list(s)}
        for p, s in zip(phi, seen, strict=True)
    ]
    return " ".join(json.dumps(e) for e in entries).encode()


def test_known_wheels_are_found():
    log = parse_khepera(tuples(np.random.default_rng(0), scan_noise=1e-5), "log")
    found = calibrate_wheels(log)
    truth = [0.0414, 0.0410, 0.088, -0.01, 0.02, -1.5]
    np.testing.assert_allclose(found.values[:3], truth[:3], rtol=5e-3)
    np.testing.assert_allclose(found.values[3:], truth[3:], atol=2e-3)
    assert found.axle_m.low <= 0.088 <= found.axle_m.high
    assert found.axle_m.high - found.axle_m.low < 2e-3


def test_known_slip_is_found():
    # a longer log, so that the two wheels can be distinguished
    log = parse_khepera(tuples(np.random.default_rng(2), n=3000), "log")
    found = slip_of_turns(calibrate_wheels(log), 1, np.random.default_rng(0), 100)
    assert found.kr.low <= 2e-6 <= found.kr.high
    assert found.kl.low <= 1e-6 <= found.kl.high
    assert found.kr.high < 2.6e-6
    longer = slip_of_turns(calibrate_wheels(log), 8, np.random.default_rng(0), 100)
    assert longer.kr.low <= 2e-6 <= longer.kr.high  # white noise builds up alike at any length
    assert longer.n_blocks < found.n_blocks / 7


def test_recording_chains_the_laser():
    log = parse_khepera(tuples(np.random.default_rng(3), n=100, k=(0.0, 0.0)), "log")
    recording = to_recording(log, (0.0414, 0.0410), 0.088, (-0.01, 0.02, -1.5))
    steps = arc_increment(np.diff(recording.wheels.position_m, axis=0), 0.088)
    pose = np.zeros(3)
    for step in steps:
        pose = se2.compose(pose, step)
    np.testing.assert_allclose(recording.truth.poses[-1], pose, atol=0.02)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (b'{"T": 1', 1),
        (b"\n\n[1, 2]", 3),
        (b'{"T": 1, "phi_l": 0, "phi_r": 0, "sm": [0, 0]}', 1),
        (b'{"T": 0, "phi_l": 0, "phi_r": 0, "sm": [0, 0, 0]}', 1),
        (b'{"T": 1, "phi_l": NaN, "phi_r": 0, "sm": [0, 0, 0]}', 1),
        (b'{"T": 1, "phi_l": "0", "phi_r": 0, "sm": [0, 0, 0]}', 1),
        (b'{"T": 1e999, "phi_l": 0, "phi_r": 0, "sm": [0, 0, 0]}', 1),
        (b'{"T": ' + b"9" * 5000 + b"}", 1),
        (b"[" * 100_000, 1),
        (b"\n\xff", 2),
    ],
)
def test_malformed(text, line):
    with pytest.raises(InputError, match=f"^log:{line}: not "):
        parse_khepera(text, "log")


@needs_data
@pytest.mark.parametrize("run", ["l90", "lmov"])
def test_published_geometry(run):
    found = calibrate_wheels(read_khepera(ARCHIVE, f"{run}.tuple"))
    published = {
        "l90": [0.0414408, 0.0411796, 0.0880134],
        "lmov": [0.0415888, 0.0414217, 0.0883953],
    }[run]
    np.testing.assert_allclose(found.values[:3], published, rtol=2e-3)
    blocks = [slip_of_turns(found, n, np.random.default_rng(0), 50) for n in (1, 8)]
    # what neighbours share with opposite signs is not slip
    assert blocks[1].kr.high < blocks[0].kr.low / 2.0
    assert 1e-7 < blocks[1].kr.value < 2e-6
    assert 1e-7 < blocks[1].kl.value < 2e-6
