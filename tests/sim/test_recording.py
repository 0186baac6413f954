import dataclasses
import os
import zipfile

import numpy as np
import pytest

from sim.errors import InputError
from sim.files import write_whole
from sim.recording import Log, Recording, Truth, WheelLog, load, log_of_readings, save
from sim.robot.drive import RobotGeometry
from sim.sensors import Encoder, Field, Laser, StereoCamera
from sim.worlds.world import World


def small_recording(seed=0):
    rng = np.random.default_rng(seed)
    stamps = np.arange(6) * 0.1
    world = World(
        "box",
        np.array([[0.0, 0, 4, 0], [4, 0, 4, 4]]),
        np.array([[0.0, 2.5]] * 2),
        landmarks=rng.normal(size=(3, 3)),
        descriptors=rng.normal(size=(3, 4)).astype(np.float32),
        look_alike=np.array([True, True, False]),
        places={"room": np.array([[0.0, 0, 4, 4]])},
    )
    laser, camera = Laser(n_beams=5), StereoCamera()
    return Recording(
        frame_stamps=stamps,
        wheels=WheelLog(stamps, np.cumsum(rng.normal(size=(6, 2)), axis=0)),
        robot=RobotGeometry(0.05, 0.19),
        sensors={"encoder": Encoder(rate_hz=100), "laser": laser, "stereo": camera},
        logs={
            "laser": Log.of(laser, stamps[::2], ranges_m=rng.random((3, 5))),
            "stereo": Log.of(
                camera,
                stamps[1::3],
                np.array([0, 2, 3]),
                points_in_camera=rng.normal(size=(3, 3)),
                ids=np.array([0, 2, 1]),
                descriptors=rng.normal(size=(3, 4)),
            ),
        },
        truth=Truth(
            stamps,
            rng.normal(size=(6, 3)),
            rng.normal(size=(6, 2)),
            {"stereo": {"true_ids": np.array([0, 2, 1])}},
            world,
        ),
        config={"seed": seed, "robot": {"kr": 1e-5}},
        status="collision at 0.5 s",
    )


def test_round_trip_keeps_every_bit(tmp_path):
    path, recording = tmp_path / "a.npz", small_recording()
    checksum = save(recording, path)
    back = load(path)
    assert back.checksum == checksum == recording.checksum
    assert back.status == recording.status
    assert back.config == recording.config
    assert back.truth.world.places["room"].tolist() == [[0.0, 0, 4, 4]]
    assert back.truth.world.look_alike.tolist() == [True, True, False]
    for ours, theirs in zip(recording.frames(), back.frames(), strict=True):
        assert ours.stamp == theirs.stamp
        assert np.array_equal(ours.wheel_increments_m, theirs.wheel_increments_m)
        assert ours.readings.keys() == theirs.readings.keys()
        for name, reading in ours.readings.items():
            for field, values in reading.items():
                assert values.dtype == theirs.readings[name][field].dtype
                assert np.array_equal(values, theirs.readings[name][field])
    assert back.sensors == recording.sensors
    assert back.truth.readings["stereo"]["true_ids"].tolist() == [0, 2, 1]


def test_every_single_value_counts_in_the_checksum():
    recording = small_recording()
    before = recording.checksum
    for name, array in {
        "wheels": recording.wheels.position_m,
        "laser": recording.log("laser")["ranges_m"],
        "splits": recording.log("stereo").splits,
        "true ids": recording.truth.readings["stereo"]["true_ids"],
        "poses": recording.truth.poses,
    }.items():
        array.setflags(write=True)
        kept = array.flat[-1]
        floats = array.dtype.kind == "f"
        array.flat[-1] = np.nextafter(kept, array.dtype.type(9)) if floats else kept + 1
        assert dataclasses.replace(recording).checksum != before, name
        array.setflags(write=True)
        array.flat[-1] = kept
    assert dataclasses.replace(recording).checksum == before
    assert dataclasses.replace(recording, status="ok").checksum != before


def test_frames_show_each_sensor_when_it_fires():
    frames = list(small_recording().frames())
    assert ["laser" in f.readings for f in frames] == [True, False] * 3
    assert ["stereo" in f.readings for f in frames] == [False, True, False, False, True, False]
    assert len(frames[1].readings["stereo"]["points_in_camera"]) == 2
    assert frames[4].readings["stereo"]["ids"].tolist() == [1]
    assert frames[0].duration_s == 0.0
    assert frames[0].wheel_increments_m.tolist() == [0.0, 0.0]
    total = sum(f.wheel_increments_m for f in frames)
    position = small_recording().wheels.position_m
    assert np.allclose(total, position[-1] - position[0])
    with pytest.raises(ValueError, match="read-only"):
        frames[0].readings["laser"]["ranges_m"][0] = 1.0
    assert "true_ids" not in frames[1].readings["stereo"]
    assert not hasattr(frames[0], "truth")


def test_wheels_are_interpolated_between_their_stamps():
    stamps = np.array([0.0, 1.0])
    recording = Recording(
        frame_stamps=np.array([0.0, 0.25, 1.0]),
        wheels=WheelLog(stamps, np.array([[0.0, 0.0], [4.0, 2.0]])),
        robot=RobotGeometry(0.05, 0.19),
        sensors={},
    )
    increments = [f.wheel_increments_m.tolist() for f in recording.frames()]
    assert increments == [[0, 0], [1, 0.5], [3, 1.5]]


def test_truth_is_interpolated_the_short_way_round():
    truth = Truth(np.array([0.0, 1.0]), np.array([[0, 0, 3.0], [1, 0, -3.0]]))
    recording = dataclasses.replace(small_recording(), truth=truth)
    middle, outside = recording.truth_at(np.array([0.5, 2.0]))
    assert abs(abs(middle[2]) - np.pi) < 1e-12
    assert np.isnan(outside).all()


def test_truth_is_not_interpolated_over_gaps():
    stamps = np.array([0.0, 0.1, 2.0, 2.1])
    truth = Truth(stamps, np.column_stack([stamps, stamps, np.zeros(4)]))
    recording = dataclasses.replace(small_recording(), truth=truth)
    asked = np.array([-0.1, 0.0, 0.05, 0.1, 1.0, 2.0, 2.05, 2.1, 2.2])
    known = np.isfinite(recording.truth_at(asked, longest_gap_s=0.5)).all(axis=1)
    assert known.tolist() == [False, True, True, True, False, True, True, True, False]
    assert np.isfinite(recording.truth_at(asked)).all(axis=1).tolist() == [
        False,
        *[True] * 7,
        False,
    ]


def test_what_is_missing_is_named():
    blind = dataclasses.replace(small_recording().without("laser").without("stereo"), truth=None)
    assert blind.world is None
    with pytest.raises(InputError, match="no truth"):
        _ = blind.known_truth
    with pytest.raises(InputError, match="no map"):
        _ = blind.known_world
    with pytest.raises(InputError, match=r"no readings of a sensor laser \(there is none\)"):
        blind.log("laser")
    with pytest.raises(InputError, match=r"no sensor named laser \(there is encoder\); choose"):
        blind.sensor("laser", Laser)
    with pytest.raises(InputError, match=r"a sensor place \(there is laser, stereo\)"):
        small_recording().log("place")
    with pytest.raises(InputError, match="sensor laser is a Laser, not a StereoCamera"):
        small_recording().sensor("laser", StereoCamera)
    with pytest.raises(InputError, match="no splits"):
        _ = small_recording().log("laser").known_splits


def test_what_is_there_is_given():
    recording = small_recording()
    assert recording.known_truth is recording.truth
    assert recording.known_world is recording.world is recording.truth.world
    for name, kind in (("laser", Laser), ("stereo", StereoCamera)):
        assert recording.log(name) is recording.logs[name]
        assert recording.sensor(name, kind) is recording.sensors[name]
    log = recording.log("stereo")
    assert log.known_splits is log.splits
    assert log["ids"] is log.values["ids"]


def test_a_log_is_added_changed_and_taken_away(tmp_path):
    recording, rear = small_recording(), Laser(n_beams=2)
    log = Log.of(rear, np.array([0.1]), ranges_m=np.ones((1, 2)))
    more = recording.with_log("rear", log, rear)
    assert [*more.logs] == ["laser", "stereo", "rear"]
    assert [("laser" in f.readings, "rear" in f.readings) for f in more.frames()][:2] == [
        (True, False),
        (False, True),
    ]
    changed = more.with_log("rear", Log.of(rear, np.array([0.1]), ranges_m=np.zeros((1, 2))))
    assert changed.sensors["rear"] is rear
    assert changed.checksum != more.checksum
    assert more.without("rear").checksum == recording.checksum
    less = recording.without("stereo")
    assert "stereo" not in less.sensors
    assert "stereo" not in less.truth.readings
    assert save(less, tmp_path / "less.npz") == load(tmp_path / "less.npz").checksum


SCHEMA = {
    "count": Field(dtype="i4"),
    "colour": Field(dtype="u1", shape=(3,)),
    "image": Field("m", "f4", (None, 2)),
    "points": Field("m", shape=(2,), ragged=True),
    "weights": Field(ragged=True),
}


def some_log(**changes):
    """Two readings of a sensor with every kind of field; the second has no points."""
    values = {
        "count": np.array([1, 2], np.int32),
        "colour": np.zeros((2, 3), np.uint8),
        "image": np.zeros((2, 4, 2), np.float32),
        "points": np.ones((3, 2)),
        "weights": np.arange(3.0),
    }
    splits = changes.pop("splits", np.array([0, 3, 3]))
    stamps = changes.pop("stamps", np.array([0.0, 0.5]))
    return Log(SCHEMA, stamps, {**values, **changes}, splits)


def test_a_log_gives_its_readings():
    log = some_log()
    log.check("s")
    first, second = log.reading(0), log.reading(1)
    assert {name: np.shape(values) for name, values in first.items()} == {
        "count": (),
        "colour": (3,),
        "image": (4, 2),
        "points": (3, 2),
        "weights": (3,),
    }
    assert (first["count"], second["count"]) == (1, 2)
    assert second["points"].shape == (0, 2)
    again = log_of_readings(SCHEMA, log.stamps, [first, second], "s")
    for name, values in log.values.items():
        assert again[name].dtype == values.dtype
        np.testing.assert_array_equal(again[name], values)
    np.testing.assert_array_equal(again.splits, log.splits)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"count": np.zeros(2)}, r"s\.count must be i4, got float64"),
        ({"count": np.zeros(3, np.int32)}, r"s\.count must have shape \(2\), got \(3,\)"),
        ({"colour": np.zeros((2, 4), np.uint8)}, r"s\.colour must have shape \(2, 3\)"),
        ({"image": np.zeros((2, 4, 3), np.float32)}, r"s\.image must have shape \(2, any, 2\)"),
        ({"image": np.zeros((2, 4), np.float32)}, r"s\.image must have shape"),
        ({"points": np.zeros((2, 2))}, r"s\.points must have shape \(3, 2\)"),
        ({"weights": np.zeros(4)}, r"s\.weights must have shape \(3\)"),
        ({"splits": None}, r"s\.splits must be there if a field is ragged"),
        ({"splits": np.array([0, 3])}, r"s\.splits must be int64 of shape \(3,\)"),
        ({"splits": np.array([0.0, 3.0, 3.0])}, r"s\.splits must be int64"),
        ({"splits": np.array([1, 3, 3])}, "begin at 0"),
        ({"splits": np.array([0, 4, 3])}, "not decrease"),
        ({"stamps": np.array([0, 1])}, r"s\.stamps must be float64"),
        ({"stamps": np.zeros((2, 1))}, r"s\.stamps must be float64"),
    ],
)
def test_a_log_that_does_not_fit_its_schema(changes, words):
    with pytest.raises(InputError, match=words):
        some_log(**changes).check("s")


def test_splits_without_a_ragged_field_are_refused():
    schema = {"count": Field(dtype="i4")}
    log = Log(schema, np.zeros(2), {"count": np.zeros(2, np.int32)}, np.array([0, 1, 2]))
    with pytest.raises(InputError, match="only then"):
        log.check("s")


def test_log_of_a_sensor_wants_its_fields():
    laser = Laser(n_beams=3)
    log = Log.of(laser, np.zeros(2), ranges_m=np.ones((2, 3)))
    assert log["ranges_m"].dtype == np.float32
    for values in ({}, {"range_m": np.ones((2, 3))}, {"ranges_m": 1, "more": 2}):
        with pytest.raises(InputError, match=r"a Laser has the fields \['ranges_m'\], got"):
            Log.of(laser, np.zeros(2), **values)
    with pytest.raises(InputError, match=r"Laser\.ranges_m must have shape \(2, 3\)"):
        Log.of(laser, np.zeros(2), ranges_m=np.ones((2, 4)))
    with pytest.raises(InputError, match="'true_ids'"):  # it belongs to the truth
        Log.of(
            StereoCamera(),
            np.zeros(0),
            np.zeros(1, np.int64),
            points_in_camera=np.zeros((0, 3)),
            ids=np.zeros(0),
            descriptors=np.zeros((0, 2)),
            true_ids=np.zeros(0),
        )


def test_readings_are_joined_by_their_field():
    plain, ragged = Field(shape=(2,)), Field(dtype="i8", shape=(None,), ragged=True)
    assert plain.stack([[1, 2], (3, 4), np.zeros(2)], "f").tolist() == [[1, 2], [3, 4], [0, 0]]
    assert Field().stack([1.0, np.array(2.0)], "f").tolist() == [1.0, 2.0]
    rows = ragged.stack([np.ones((2, 3)), np.zeros((0, 3)), np.ones((1, 3))], "f")
    assert (rows.shape, rows.dtype) == ((3, 3), np.int64)
    assert plain.stack([], "f").shape == (0, 2)
    assert ragged.stack([], "f").shape == (0, 0)
    with pytest.raises(InputError, match=r"f must have shape \(1, 2\), got \(1, 3\)"):
        plain.stack([[1, 2, 3]], "f")
    for field, readings in (
        (plain, [[1, 2], [1, 2, 3]]),
        (ragged, [np.ones((1, 3)), np.ones((1, 2))]),
        (Field(), ["north"]),
    ):
        with pytest.raises(InputError, match="f: readings that do not go together"):
            field.stack(readings, "f")
    with pytest.raises(InputError, match=r"dtype must be one of .*'complex'"):
        Field(dtype="complex")


def test_ragged_fields_of_a_reading_have_as_many_rows():
    """Sums that happen to agree would give rows to the wrong reading."""
    schema = {"points": Field(shape=(2,), ragged=True), "ids": Field(dtype="i8", ragged=True)}
    odd = [
        {"points": np.ones((2, 2)), "ids": np.zeros(1)},
        {"points": np.ones((1, 2)), "ids": np.zeros(2)},
    ]
    with pytest.raises(InputError, match=r"s\.ids has 1 rows? in a reading, s\.points 2"):
        log_of_readings(schema, np.zeros(2), odd, "s")
    with pytest.raises(InputError, match=r"s\.ids: readings that do not go together"):
        log_of_readings(schema, np.zeros(1), [{"points": np.ones((1, 2)), "ids": 3}], "s")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"logs": {"laser": 0.05}}, r"laser has a reading at 0\.05 s, and no Frame is then"),
        ({"wheels": 1}, r"wheels\.stamps leave 0\.5 s of its Frames without a reading"),
        ({"wheels": 4}, r"wheels\.stamps leave 0\.2 s of its Frames without a reading"),
    ],
    ids=["between Frames", "one of the wheels", "wheels end early"],
)
def test_readings_that_no_frame_would_show(tmp_path, change, words):
    recording = small_recording()
    if "wheels" in change:
        wheels = WheelLog(*(v[: change["wheels"]] for v in vars(recording.wheels).values()))
        recording = dataclasses.replace(recording, wheels=wheels)
    else:
        log = recording.logs["laser"]
        moved = dataclasses.replace(log, stamps=log.stamps + change["logs"]["laser"])
        recording = recording.with_log("laser", moved)
    save(recording, tmp_path / "a.npz")
    with pytest.raises(InputError, match=words):
        load(tmp_path / "a.npz")


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "text", "other_zip"])
def test_damaged_files_are_refused_by_name(tmp_path, damage):
    path = tmp_path / "a.npz"
    save(small_recording(), path)
    whole = path.read_bytes()
    if damage == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif damage == "flip":
        middle = whole.index(b"wheels.position_m") + 160
        path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "text":
        path.write_text("stamps, ranges")
    else:
        with zipfile.ZipFile(path, "w") as other:
            other.writestr("meta.npy", b"nonsense")
    with pytest.raises(InputError, match=r"a\.npz: .*record again") as caught:
        load(path)
    assert "\n" not in str(caught.value)


def test_every_flipped_byte_is_noticed_or_harmless(tmp_path):
    path, recording = tmp_path / "a.npz", small_recording()
    checksum = save(recording, path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for position in rng.choice(len(whole), 150, replace=False):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
        try:
            assert load(path).checksum == checksum
        except InputError:
            continue


def test_pickles_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, meta=np.array([{"format": 1}], dtype=object))
    with pytest.raises(InputError, match=r"no file of arrays .*type object"):
        load(path)


def test_a_missing_file_names_the_remedy(tmp_path):
    with pytest.raises(InputError, match="estima record"):
        load(tmp_path / "none.npz")


def test_failed_writes_leave_nothing(tmp_path):
    path = tmp_path / "out.csv"

    def write_half():
        with write_whole(path) as part:
            part.write_text("half")
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError):
        write_half()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_is_reported_in_one_line(tmp_path, monkeypatch):
    real = np.savez

    def savez_to_full_disk(file, **arrays):
        with open("/dev/full", "wb", buffering=0) as full:
            full.write(b"x")
        real(file, **arrays)

    monkeypatch.setattr(np, "savez", savez_to_full_disk)
    with pytest.raises(InputError, match=r"cannot write \(No space left.*free some space"):
        save(small_recording(), tmp_path / "a.npz")
    assert list(tmp_path.iterdir()) == []


def test_travel_is_that_of_the_believed_wheels():
    recording = small_recording()
    assert recording.with_wheel_radius(recording.robot.wheel_radius_m) is recording
    larger = recording.with_wheel_radius(2.0 * recording.robot.wheel_radius_m)
    for ours, theirs in zip(recording.frames(), larger.frames(), strict=True):
        assert np.allclose(2.0 * ours.wheel_increments_m, theirs.wheel_increments_m)


def test_frames_own_their_arrays():
    recording = small_recording()
    for frame in recording.frames():
        for values in (frame.wheel_increments_m, *(v for r in frame.readings.values()
                                                   for v in r.values())):  # fmt: skip
            assert isinstance(values.base, bytes)
            with pytest.raises(ValueError, match="cannot set WRITEABLE"):
                values.setflags(write=True)
