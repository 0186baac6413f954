"""Sensors that the package does not know, and several of a kind: all the way through the files."""

import dataclasses
import json
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from experiments.cli.main import app
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.trajectories.convert import write_recording
from sim.errors import InputError
from sim.formats.detect import read_any
from sim.formats.rosbag_in import read_bag
from sim.recording import Log, load, save
from sim.robot.drive import DifferentialDrive
from sim.routes.route import OpenLoop
from sim.sensors import (
    Encoder,
    Field,
    Gyroscope,
    Laser,
    Mount,
    StereoCamera,
    sensors_from_config,
)
from sim.sensors.base import RecordedSensor, schema_from_meta
from sim.simulate import Member, record
from tests.fixtures.beacons import Beacons, Compass, Forgetful
from tests.fixtures.fakes import square_room

FRONT, REAR = (
    Laser(n_beams=31),
    Laser(rate_hz=5.0, n_beams=17, mount=Mount(x_m=-0.1, yaw_rad=np.pi)),
)
SENSORS = {"encoder": Encoder(), "beacons": Beacons(), "laser": FRONT}
COUNTS, ANY_COUNTS = Field("", "i4", (3,)), Field("", "i4", (None,))
ENDINGS = [".mcap", ".bag", ".db3", ""]
QUICK = ["simulation.physics=kinematic", "simulation.rays=exact", "world=room", "route=linear_1"]


def drive(sensors, seconds=2.0, seed=0):
    streams = {axis: np.random.default_rng([seed, i]) for i, axis in enumerate(("slip", "sensors"))}
    return record(
        square_room(),
        Member(
            DifferentialDrive(wheel_radius_m=0.05, track_m=0.19, kr=1e-4, kl=1e-4),
            sensors,
            OpenLoop(segments=((0.2, 0.3, seconds),)),
            streams,
        ),
        physics="kinematic",
        rays="exact",
    )


@pytest.fixture(scope="module")
def recording():
    return drive(SENSORS)


def same_log(ours, theirs):
    assert dict(ours.schema) == dict(theirs.schema)
    np.testing.assert_array_equal(ours.stamps, theirs.stamps)
    np.testing.assert_array_equal(ours.splits, theirs.splits)
    for name, values in ours.values.items():
        assert values.dtype == theirs[name].dtype, name
        np.testing.assert_array_equal(values, theirs[name], err_msg=name)


def same_truth(ours, theirs):
    assert ours.truth.readings.keys() == theirs.truth.readings.keys()
    for name, hidden in ours.truth.readings.items():
        assert hidden.keys() == theirs.truth.readings[name].keys()
        for key, values in hidden.items():
            assert values.dtype == theirs.truth.readings[name][key].dtype
            np.testing.assert_array_equal(values, theirs.truth.readings[name][key])


def test_it_is_recorded_by_its_schema(recording):
    log, hidden = recording.log("beacons"), recording.truth.readings["beacons"]
    assert [*log.values] == ["battery_v", "strength", "ranges_m", "ids", "colours"]
    assert [*hidden] == ["true_ranges_m", "temperature"]
    assert log.schema["ids"].dtype == "i4"
    counts = np.diff(log.splits)
    assert len(set(counts)) > 1
    assert counts.sum() == len(log["ranges_m"]) == len(hidden["true_ranges_m"])
    error = log["ranges_m"] - hidden["true_ranges_m"]
    assert np.std(error) == pytest.approx(0.1, rel=0.2)
    # its probe has a state, and knows how long the last reading was ago
    np.testing.assert_allclose(np.diff(log["battery_v"]), -0.01 * np.diff(log.stamps))
    assert 4.9 < log["battery_v"][0] < 5.0
    first = next(frame for frame in recording.frames() if "beacons" in frame.readings)
    reading = first.readings["beacons"]
    assert reading.keys() == log.values.keys()
    assert reading["colours"].shape == (counts[0], 3)
    with pytest.raises(ValueError, match="read-only"):
        reading["ranges_m"][0] = 0.0


def test_saved_and_loaded_its_class_is_not_needed(recording, tmp_path):
    checksum = save(recording, tmp_path / "a.npz")
    back = load(tmp_path / "a.npz")
    assert back.checksum == checksum == recording.checksum
    same_log(recording.log("beacons"), back.log("beacons"))
    same_truth(recording, back)
    sensor = back.sensors["beacons"]
    assert isinstance(sensor, RecordedSensor)
    assert sensor.target == "tests.fixtures.beacons.Beacons"
    assert (sensor.reach_m, sensor.channels, sensor.mount) == (4.0, 2, Mount(x_m=0.1))
    assert sensor.schema == dict(Beacons().schema)
    assert back.sensors["laser"] == FRONT
    with pytest.raises(AttributeError, match="has its settings, and no reach"):
        _ = sensor.reach
    with pytest.raises(InputError, match=r"tests\.fixtures\.beacons\.Beacons cannot be simulated"):
        sensor.start(np.random.default_rng(0))
    with pytest.raises(InputError, match=r"sensor beacons was recorded as tests"):
        back.sensor("beacons", Laser)
    assert save(back, tmp_path / "b.npz") == checksum


@pytest.mark.parametrize("ending", ENDINGS)
def test_bags_hold_it_by_its_schema(recording, tmp_path, ending):
    pytest.importorskip("rosbags")
    write_recording(tmp_path / f"run{ending}", recording)
    back = read_any([tmp_path / f"run{ending}"])
    same_log(recording.log("beacons"), back.log("beacons"))
    same_log(recording.log("laser"), back.log("laser"))
    same_truth(recording, back)
    assert isinstance(back.sensors["beacons"], RecordedSensor)
    assert back.sensors["beacons"].mount == Mount(x_m=0.1)
    # and from what was read to another file of the kind
    write_recording(tmp_path / f"again{ending}", back)
    again = read_any([tmp_path / f"again{ending}"])
    same_log(recording.log("beacons"), again.log("beacons"))
    same_truth(recording, again)


def test_a_sensor_that_never_read_anything(tmp_path):
    pytest.importorskip("rosbags")
    quiet = drive({"encoder": Encoder(), "gyroscope": Gyroscope(rate_hz=1.0)}, seconds=0.3)
    assert len(quiet.log("gyroscope").stamps) == 0
    assert quiet.truth.readings["gyroscope"]["bias_radps"].shape == (0,)
    assert save(quiet, tmp_path / "a.npz") == load(tmp_path / "a.npz").checksum
    write_recording(tmp_path / "a.mcap", quiet)
    same_log(quiet.log("gyroscope"), read_bag(tmp_path / "a.mcap").log("gyroscope"))
    nothing = drive({"encoder": Encoder(), "beacons": Beacons(reach_m=1e-3)}, seconds=0.3)
    assert len(nothing.log("beacons")["ids"]) == 0
    write_recording(tmp_path / "b.bag", nothing)
    same_log(nothing.log("beacons"), read_bag(tmp_path / "b.bag").log("beacons"))


def test_an_independent_reader_sees_the_same(recording, tmp_path):
    """MCAP's own library, which knows the message from the definition in the file alone."""
    mcap_reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    write_recording(tmp_path / "run.mcap", recording)
    found = {"/sensors/beacons": [], "/ground_truth/sensors/beacons": [], "/tf_static": []}
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = mcap_reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages(topics=[*found]):
            found[channel.topic].append((schema.name, message))
    kinds = [{kind for kind, _ in messages} for messages in found.values()]
    assert kinds[:2] == [{"estima_msgs/msg/Beacons"}, {"estima_msgs/msg/BeaconsTruth"}]
    log, hidden = recording.log("beacons"), recording.truth.readings["beacons"]
    readings = [message for _, message in found["/sensors/beacons"]]
    assert len(readings) == len(log.stamps)
    for row, message in enumerate(readings):
        reading = log.reading(row)
        stamp = message.header.stamp
        assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(log.stamps[row], abs=1e-9)
        assert message.header.frame_id == "beacons"
        assert message.battery_v == reading["battery_v"]
        np.testing.assert_array_equal(message.ranges_m, reading["ranges_m"])
        np.testing.assert_array_equal(message.ids, reading["ids"])
        np.testing.assert_array_equal(list(message.colours_shape), reading["colours"].shape)
        np.testing.assert_array_equal(
            np.array(list(message.colours)).reshape(-1, 3), reading["colours"]
        )
        assert not hasattr(message, "true_ranges_m")
    true = np.concatenate([m.true_ranges_m for _, m in found["/ground_truth/sensors/beacons"]])
    np.testing.assert_array_equal(true, hidden["true_ranges_m"])
    ((_, static),) = found["/tf_static"]
    assert {t.child_frame_id for t in static.transforms} == {"beacons", "laser"}


def test_a_standard_message_of_a_foreign_class_comes_back(tmp_path):
    """The file does not say how to read it; its readings by the schema lie beside it."""
    rosbag2 = pytest.importorskip("rosbags.highlevel")
    compass = drive({"encoder": Encoder(), "compass": Compass()}, seconds=0.5)
    write_recording(tmp_path / "run.mcap", compass)
    same_log(compass.log("compass"), read_bag(tmp_path / "run.mcap").log("compass"))
    with rosbag2.AnyReader([tmp_path / "run.mcap"]) as reader:
        kinds = {connection.topic: connection.msgtype for connection in reader.connections}
    assert kinds["/compass"] == "sensor_msgs/msg/Imu"


def test_the_commands(recording, tmp_path):
    pytest.importorskip("rosbags")

    def invoke(*words):
        done = CliRunner().invoke(app, [*map(str, words)])
        assert done.exit_code == 0, done.output or done.exception
        return done.output

    save(recording, tmp_path / "a.npz")
    said = invoke("info", tmp_path / "a.npz")
    assert "beacons     " in said
    assert "battery_v, V, 100.0 % finite" in said
    assert "strength, 2, 100.0 % finite" in said
    assert "colours, 3, " in said
    assert "rows a reading" in said
    assert recording.checksum in said
    assert "true_ranges_m" not in said
    invoke("convert", tmp_path / "a.npz", "-o", tmp_path / "b.mcap")
    invoke("convert", tmp_path / "b.mcap", "-o", tmp_path / "c.bag")
    invoke("convert", tmp_path / "c.bag", "-o", tmp_path / "d.npz")
    back = load(tmp_path / "d.npz")
    same_log(recording.log("beacons"), back.log("beacons"))
    same_truth(recording, back)
    invoke("view", tmp_path / "a.npz", "-o", tmp_path / "a.gif", "--seconds", "0.3")
    assert (tmp_path / "a.gif").stat().st_size > 1000


def test_from_the_configuration_to_a_row(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    given = ["+sensors.beacons={_target_: tests.fixtures.beacons.Beacons, reach_m: 3}", *QUICK]
    experiment = Experiment.compose(given)
    first, cached = experiment.recording(), experiment.recording()
    assert first.checksum == cached.checksum
    for made in (first, cached):  # the configuration names the class, so it may be used
        assert made.sensors["beacons"] == Beacons(reach_m=3.0)
    (row,) = evaluate(experiment)
    assert row["status"] == "ok"
    for wrong, words in (
        (
            "{_target_: tests.fixtures.beacons.Beacons, reach: 3}",
            r"unknown key sensors\.beacons\.reach",
        ),
        ("{_target_: tests.fixtures.beacons.Beacons, reach_m: -3}", "reach_m must be positive"),
        ("{_target_: tests.fixtures.beacons.Nothing}", "has no class Nothing"),
        ("{_target_: tests.fixtures.beacons.BadName}", "'stamps' cannot be the name of a field"),
        ("{_target_: tests.fixtures.beacons.HiddenRows}", "a ragged truth field needs a measured"),
    ):
        with pytest.raises(InputError, match=words):
            Experiment.compose([f"+sensors.beacons={wrong}", *QUICK]).simulate()


def test_a_reading_without_a_field_of_the_schema_is_named():
    with pytest.raises(
        InputError, match=r"sensors\.f: a reading must have the fields .* got \{'battery_v'"
    ):
        drive({"encoder": Encoder(), "f": Forgetful()}, seconds=0.3)


def recorded_as(recording, name, schema):
    """The recording with two readings of a sensor of this schema."""
    sensor = RecordedSensor("elsewhere.Sensor", {}, schema)
    sizes = {key: (2, *(size or 4 for size in field.shape)) for key, field in schema.items()}
    values = {key: np.arange(np.prod(size)).reshape(size) for key, size in sizes.items()}
    return recording.with_log(name, Log.of(sensor, np.array([0.0, 0.1]), **values), sensor)


@pytest.mark.parametrize("ending", [".mcap", ".bag"])
def test_fields_of_any_name(tmp_path, ending):
    """Names that functions of the writer have too."""
    pytest.importorskip("rosbags")
    names = ("self", "kind", "topic", "stamp", "sensor", "cls", "string", "float64", "A", "a__b_")
    odd = recorded_as(drive({"encoder": Encoder()}, 0.3), "x", dict.fromkeys(names, COUNTS))
    assert save(odd, tmp_path / "a.npz") == load(tmp_path / "a.npz").checksum
    write_recording(tmp_path / f"a{ending}", odd)
    same_log(odd.log("x"), read_bag(tmp_path / f"a{ending}").log("x"))


def test_names_that_cannot_be():
    for name in ("class", "from", "None", "header", "splits", "a b", "a.b", "_a", "1", ""):
        with pytest.raises(InputError, match="cannot be the name of a field"):
            schema_from_meta({name: {"unit": "", "dtype": "f8", "shape": []}})


@pytest.mark.parametrize(
    "schemas",
    [
        {"aB": {"a": COUNTS}, "ab": {"b": COUNTS}},
        {"x": {"a": ANY_COUNTS, "a_shape": COUNTS}},  # an open size is written beside the values
    ],
)
def test_messages_that_would_be_called_the_same(tmp_path, schemas):
    pytest.importorskip("rosbags")
    odd = drive({"encoder": Encoder()}, 0.3)
    for name, schema in schemas.items():
        odd = recorded_as(odd, name, schema)
    with pytest.raises(InputError, match="rename a sensor or a field") as caught:
        write_recording(tmp_path / "a.mcap", odd)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


# Several sensors


def test_two_lasers_are_told_apart_by_their_names(tmp_path):
    given = [
        *QUICK,
        "sensors=hokuyo",
        "estimator=icp_odometry",
        "+sensors.rear={_target_: sim.sensors.laser.Laser, n_beams: 91, rate_hz: 10.0, "
        "mount: {x_m: -0.1, yaw_rad: 3.14159}}",
        "sensors.laser.n_beams=91",
    ]
    both = Experiment.compose(given)
    recording = both.simulate()
    assert recording.log("rear")["ranges_m"].shape == recording.log("laser")["ranges_m"].shape
    prior = both.prior(recording)

    def follow(name, recording):
        estimator = Experiment.compose([*given, f"estimator.laser={name}"]).estimator()
        estimator.reset(prior, np.random.default_rng(0))
        return np.array([estimator.step(frame).mean for frame in recording.frames()])

    front, rear = (follow(name, recording) for name in ("laser", "rear"))
    truth = recording.truth_at(recording.frame_stamps)
    for means in (front, rear):
        assert np.abs(means - truth)[:, :2].max() < 0.3
    assert not np.array_equal(front, rear)
    # each reads its own alone
    blank = np.full_like(recording.log("laser")["ranges_m"], np.inf)
    log = dataclasses.replace(recording.log("laser"), values={"ranges_m": blank})
    np.testing.assert_array_equal(follow("rear", recording.with_log("laser", log)), rear)
    assert not np.array_equal(follow("laser", recording.with_log("laser", log)), front)
    with pytest.raises(InputError, match=r"needs a sensor side, and sensors=hokuyo has none"):
        Experiment.compose([*given, "estimator.laser=side"]).check()
    with pytest.raises(InputError, match="icp_odometry: no sensor named side"):
        follow("side", recording)


@pytest.mark.parametrize("ending", ENDINGS)
def test_two_lasers_have_topics_of_their_own(tmp_path, ending):
    pytest.importorskip("rosbags")
    both = drive({"front": FRONT, "rear": REAR}, seconds=1.0)
    write_recording(tmp_path / f"run{ending}", both)
    back = read_any([tmp_path / f"run{ending}"])
    assert back.sensors == both.sensors
    for name in ("front", "rear"):
        same_log(both.log(name), back.log(name))


def test_the_noise_of_a_sensor_does_not_depend_on_the_others():
    one, two = Gyroscope(rate_hz=50.0), Beacons()
    alone = drive({"gyro": one})
    for others in (
        {"gyro": one, "beacons": two},
        {"beacons": two, "gyro": one},
        {"laser": FRONT, "stereo": StereoCamera(), "gyro": one, "gyro_2": one},
    ):
        together = drive(others)
        same_log(alone.log("gyro"), together.log("gyro"))
        same = together.truth.readings["gyro"]["bias_radps"]
        np.testing.assert_array_equal(alone.truth.readings["gyro"]["bias_radps"], same)
    # two of a kind do not share their noise
    first, second = together.log("gyro"), together.log("gyro_2")
    assert not np.isin(first["yaw_rate_radps"], second["yaw_rate_radps"]).any()
    laser = drive({"laser": FRONT})
    same_log(laser.log("laser"), drive({"laser": FRONT, "gyro": one}).log("laser"))
    assert drive({"gyro": one}, seed=1).checksum != alone.checksum


# Files that nobody should trust


TRAP = "raise SystemExit('a file chose what code runs')\n"


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A module that ends the process if it is imported."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "trap_module.py").write_text(TRAP)
    return "trap_module.Sensor"


def described_as(recording, target):
    """The recording, with its beacons' class by another name."""
    beacons = recording.sensors["beacons"]
    settings = {"reach_m": beacons.reach_m}
    other = RecordedSensor(target, settings, beacons.schema)
    return recording.with_log("beacons", recording.log("beacons"), other)


@pytest.mark.parametrize("ending", [".npz", ".mcap", ".bag"])
def test_a_file_does_not_choose_what_is_imported(recording, tmp_path, trap, ending):
    pytest.importorskip("rosbags")
    write_recording(tmp_path / f"evil{ending}", described_as(recording, trap))
    back = read_any([tmp_path / f"evil{ending}"])
    assert back.sensors["beacons"].target == trap
    same_log(recording.log("beacons"), back.log("beacons"))
    CliRunner().invoke(app, ["info", str(tmp_path / f"evil{ending}")])
    assert "trap_module" not in sys.modules
    with pytest.raises(InputError, match="a file chose"):  # it is armed
        sensors_from_config({"s": {"_target_": trap}})


@pytest.mark.parametrize(
    "target",
    [
        "sim.sensors.nowhere.Laser",
        "sim.sensors.laser.nothing",
        "sim.sensors.laser.noisy_ranges",
        "sim.sensors.base.build",
        "sim.sensors.base.World",
        "sim.sensors.base.RecordedSensor",
        "sim.sensors..os.system",
        "sim.sensors.",
    ],
)
def test_only_sensors_of_the_package_are_made(recording, tmp_path, target):
    save(described_as(recording, target), tmp_path / "evil.npz")
    with pytest.raises(InputError, match=r"evil\.npz: .*record again") as caught:
        load(tmp_path / "evil.npz")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a b", "../../a", "a.b", "", "a/b\nc"])
def test_sensors_of_a_file_have_words_for_names(recording, tmp_path, name):
    log, sensor = recording.log("beacons"), recording.sensors["beacons"]
    odd = drive({"encoder": Encoder()}, seconds=0.3).with_log(name, log, sensor)
    save(odd, tmp_path / "evil.npz")
    with pytest.raises(InputError, match="one word of letters and digits") as caught:
        load(tmp_path / "evil.npz")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("field", "words"),
    [
        ({"dtype": "O"}, "dtype must be one of"),
        ({"shape": 3}, "record again"),
        ({"shape": [4]}, "must have shape"),
        ({"colour": "red"}, "record again"),
        ({"ragged": False}, "must have shape"),
    ],
)
def test_a_schema_that_does_not_fit_the_file(recording, tmp_path, field, words):
    from sim import recording as module

    save(recording, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as archive:
        arrays = {name: archive[name] for name in archive.files}
    meta = json.loads(arrays.pop("meta").tobytes())
    del meta["checksum"]
    meta["schemas"]["beacons"]["ranges_m"] |= field
    meta["checksum"] = module.digest_of(arrays, meta)
    arrays["meta"] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(InputError, match=words) as caught:
        load(tmp_path / "b.npz")
    assert "\n" not in str(caught.value)
