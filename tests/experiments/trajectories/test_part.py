"""A part of a log, and a truth from a file of its own."""

import numpy as np
import pytest

from experiments.trajectories.convert import convert_log
from experiments.trajectories.part import Part
from sim.errors import InputError
from sim.formats.tum import write_tum
from sim.recording import load, save
from sim.recording_check import check_recording
from tests.fixtures.fakes import circle


def test_part_shows_the_same_frames():
    whole = circle(n_frames=60)
    begin = whole.frame_stamps[0]
    low, high = whole.frame_stamps[[20, 40]] - begin
    part = Part(from_s=float(low), until_s=float(high)).of(whole)
    check_recording(part)
    frames = list(whole.frames())[20:41]
    for mine, theirs in zip(part.frames(), frames, strict=True):
        assert mine.stamp == theirs.stamp
        assert mine.readings.keys() == theirs.readings.keys()
        for name, reading in mine.readings.items():
            for key, values in reading.items():
                np.testing.assert_array_equal(values, theirs.readings[name][key])
        if mine.stamp > part.frame_stamps[0]:
            np.testing.assert_allclose(mine.wheel_increments_m, theirs.wheel_increments_m)
    assert all(len(log.stamps) <= 21 for log in part.logs.values())
    assert part.wheels.stamps[[0, -1]].tolist() == part.frame_stamps[[0, -1]].tolist()


def test_truth_of_a_file(tmp_path):
    whole = circle(n_frames=60)
    save(whole, tmp_path / "log.npz")
    stamps = whole.frame_stamps[10:50]
    poses = np.column_stack([stamps, 2.0 * stamps, 0.0 * stamps])
    write_tum(tmp_path / "ref.tum", stamps, poses)
    part = Part(truth=tmp_path / "ref.tum", from_s=float(stamps[0] - whole.frame_stamps[0]))
    said = convert_log([tmp_path / "log.npz"], tmp_path / "out.npz", part=part)
    assert "frames" in said
    made = load(tmp_path / "out.npz")
    np.testing.assert_allclose(made.truth.poses, poses)
    assert made.frame_stamps[0] == stamps[0]


def test_what_cannot_be_is_refused(tmp_path):
    whole = circle(n_frames=60)
    with pytest.raises(InputError, match="no two Frames"):
        Part(from_s=1e4).of(whole)
    write_tum(tmp_path / "late.tum", 1e6 + np.arange(3.0), np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"late\.tum: is from 1000000 .*the log's clock"):
        Part(truth=tmp_path / "late.tum").of(whole)
    save(whole, tmp_path / "log.npz")
    write_tum(tmp_path / "mine.tum", whole.truth.stamps, whole.truth.poses)
    with pytest.raises(InputError, match="for logs"):
        convert_log([tmp_path / "mine.tum"], tmp_path / "mine.csv", part=Part(until_s=3.0))
