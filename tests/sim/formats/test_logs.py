"""The other text formats: Intel JSON, relations, MRCLAM, Rawseeds, Lego, Wean Hall."""

import functools
import json
import math
import tarfile

import numpy as np
import pytest

from experiments.trajectories.convert import convert_log
from sim.errors import InputError
from sim.formats import detect, intel, lego, mrclam, rawseeds, relations, wean
from sim.formats.detect import read_any
from sim.formats.text import split_words
from sim.recording import save
from tests.fixtures import log_samples as samples
from tests.fixtures.fakes import true_ids
from tests.fixtures.log_samples import ARC, DATA, RANGES

needs_data = pytest.mark.skipif(not DATA.exists(), reason="no real logs here")


def words(data):
    return split_words(data if isinstance(data, bytes) else data.encode(), "log")


def write(path, data):
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


def test_intel(tmp_path):
    raw = write(tmp_path / "raw.json", samples.intel_json())
    recording = intel.read_intel(raw, raw)
    np.testing.assert_allclose(recording.truth.poses, ARC[:3])
    assert recording.log("laser")["ranges_m"].shape == (3, 4)
    assert np.isinf(recording.log("laser")["ranges_m"][0, 3])
    laser = recording.sensors["laser"]
    np.testing.assert_allclose(
        laser.bearings_rad + laser.mount.yaw_rad, np.radians([-90, -45, 0, 45]), atol=1e-9
    )


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda t: t.replace(b"[", b"(", 1), "log:4: not JSON"),
        (lambda t: b"[" * 100_000, "log:1: "),
        (lambda t: b"[]", "log:1: "),
        (lambda t: b'{"map": 3}', "log:1: "),
        (lambda t: t.replace(b"81.83", b'"x"'), "log:3: the scan at 10.0"),
        (lambda t: t.replace(b"3.1,", b"", 1), "log:14: the scan at 11.0"),
        (lambda t: t.replace(b"1.0,", b"1e999,", 1), "log:3: .*finite"),
        (lambda t: t.replace(b"12.0", b"noon"), "log:25: "),
    ],
)
def test_intel_refused(change, where):
    with pytest.raises(InputError, match=where):
        intel.parse_intel(change(samples.intel_json()), "log")


def test_relations(tmp_path):
    found = relations.read_relations(words(samples.relations()))
    np.testing.assert_allclose(found.stamps, [[1, 2], [2, 3]])
    np.testing.assert_allclose(found.motion, [[0.5, 0.1, 0.2], [0.4, -0.1, -0.1]])
    path = tmp_path / "out.relations"
    relations.write_relations(path, found)
    again = relations.read_relations(path)
    np.testing.assert_array_equal(again.motion, found.motion)
    with pytest.raises(InputError, match=r"log:2: .* 8 numbers, this has 3"):
        relations.read_relations(words(b"1 2 3 4 5 6 7 8\n1 2 3\n"))
    with pytest.raises(InputError, match=r"a trajectory \(\.tum\), not relations"):
        relations.read_relations(words(b"1 2 3 0 0 0 0.6 0.8\n2 3 4 0 0 0 1 0\n"))


def mrclam_folder(tmp_path, **changes):
    folder = tmp_path / "set"
    folder.mkdir(exist_ok=True)
    for name, data in {**samples.mrclam_members(), **changes}.items():
        (folder / name).write_bytes(data)
    return folder


def test_mrclam(tmp_path):
    folder = mrclam_folder(tmp_path)
    recording = mrclam.read_mrclam(folder, 1)
    log = recording.log("stereo")
    np.testing.assert_allclose(log.stamps, [0.2, 0.6])
    np.testing.assert_array_equal(log.splits, [0, 1, 2])
    np.testing.assert_array_equal(log["ids"], [0, 1])
    x, y, z = log["points_in_camera"][0]  # depth 2, bearing 0.1 to the left
    assert z == pytest.approx(2.0)
    assert math.atan2(-x, z) == pytest.approx(0.1)
    assert y == 0.0
    notes = recording.config["notes"]
    assert notes["observations_of_robots"] == 1
    assert notes["unknown_barcodes"] == 1
    turned = np.diff(recording.wheels.position_m[:, 0] - recording.wheels.position_m[:, 1])
    np.testing.assert_allclose(turned.sum() / mrclam.TRACK_M, 0.2 * 0.5)
    np.testing.assert_allclose(recording.truth.world.landmarks[:, :2], [[2, 0.2], [3, -0.6]])
    hidden = mrclam.read_mrclam(folder, 1, identifies=False)
    images = [f.readings["stereo"] for f in hidden.frames() if "stereo" in f.readings]
    assert images
    assert all("ids" not in image for image in images)
    np.testing.assert_array_equal(true_ids(hidden), [0, 1])


def test_which_robot_of_several_is_read_is_said(tmp_path):
    folder = mrclam_folder(tmp_path)
    assert detect.describe_choice(folder, detect.read_any([folder]), by_flag=True) == ""
    second = {k.replace("1", "2", 1): v for k, v in samples.mrclam_members().items() if "1" in k}
    folder = mrclam_folder(tmp_path, **second)
    recording = detect.read_any([folder])
    said = "set holds robots 1 to 2; robot 1 is taken: "
    choice = detect.describe_choice(folder, recording, by_flag=True)
    assert choice == f"{said}--robot N takes another"
    choice = detect.describe_choice(folder, recording, by_flag=False)
    assert choice == f"{said}for another, name what `estima convert {folder} --robot N -o " + (
        "robotN.npz` writes"
    )
    save(recording, tmp_path / "robot1.npz")
    assert detect.describe_choice(tmp_path / "robot1.npz", recording, by_flag=False) == ""
    out = tmp_path / "out.npz"
    assert convert_log([folder], out).startswith(said)
    assert convert_log([folder], out, 2).startswith(str(out))


def test_mrclam_refused(tmp_path):
    with pytest.raises(InputError, match=r"holds no Robot2_Odometry.dat; robots with odometry: 1"):
        mrclam.read_mrclam(mrclam_folder(tmp_path), 2)
    with pytest.raises(InputError, match=r"Robot1_Odometry.dat:2: .* 3 numbers, this has 2"):
        mrclam.read_mrclam(mrclam_folder(tmp_path, **{"Robot1_Odometry.dat": b"0 0 0\n1 2\n"}))
    with pytest.raises(InputError, match=r"Barcodes names 72 twice"):
        mrclam.read_mrclam(mrclam_folder(tmp_path, **{"Barcodes.dat": b"6 72\n7 72\n"}))


def test_files_and_robots_that_a_log_does_not_have(tmp_path):
    raw = write(tmp_path / "raw.json", samples.intel_json())
    with pytest.raises(InputError, match=r"raw\.json: named twice"):
        read_any([raw, raw])
    with pytest.raises(InputError, match=r"raw\.json: intel logs hold one robot"):
        read_any([raw], 3)
    save(read_any([raw]), tmp_path / "one.npz")
    with pytest.raises(InputError, match=r"its robots are 0 to 0, got 3"):
        read_any([tmp_path / "one.npz"], 3)


def test_rawseeds(tmp_path):
    odometry = write(tmp_path / "odo.csv", samples.rawseeds_odometry())
    sick = write(tmp_path / "sick.csv", samples.rawseeds_sick())
    truth = write(tmp_path / "truth.csv", samples.rawseeds_truth())
    recording = rawseeds.read_rawseeds(odometry, sick, truth)
    assert recording.log("laser")["ranges_m"].shape == (3, 4)
    np.testing.assert_allclose(recording.truth.poses, ARC)
    laser = recording.sensors["laser"]
    np.testing.assert_allclose(
        laser.bearings_rad + laser.mount.yaw_rad, np.radians([-90, -89, -88, -87]), atol=1e-9
    )
    assert rawseeds.read_trajectory(truth).covariances.shape == (4, 3, 3)
    with pytest.raises(InputError, match="log:2: "):
        rawseeds.parse_sick(words("1, 2, 0, 5, 6\n2, 3, 0, 5, 6, 7\n"))
    with pytest.raises(InputError, match=r"log:1: .*quarter"):
        rawseeds.parse_sick(words("1, 2, 7, 5, 6\n"))


def test_rawseeds_of_any_resolution_and_by_ticks(tmp_path):
    odometry = write(tmp_path / "odo.csv", samples.rawseeds_odometry())
    sick = write(tmp_path / "sick.csv", samples.rawseeds_sick())
    read = functools.partial(rawseeds.read_rawseeds, odometry, sick)
    recording = read(resolution_deg=0.25, m_per_tick=0.01)
    bearings = recording.sensors["laser"].bearings_rad + recording.sensors["laser"].mount.yaw_rad
    np.testing.assert_allclose(bearings, np.radians([-90, -89.75, -89.5, -89.25]), atol=1e-9)
    steps = np.diff(recording.wheels.position_m, axis=0)
    np.testing.assert_allclose(steps, np.tile([0.03, 0.04], (len(steps), 1)), atol=1e-12)
    with pytest.raises(InputError, match="resolution_deg"):
        read(resolution_deg=100.0)
    with pytest.raises(InputError, match="m_per_tick"):
        read(m_per_tick=0.0)


def test_lego(tmp_path):
    files = {
        "motors": samples.lego_motors(),
        "scans": samples.lego_scans(),
        "reference": samples.lego_reference(),
        "cylinders": b"L C 1500 1200 55\n",
    }
    paths = [write(tmp_path / name, data) for name, data in files.items()]
    recording = lego.read_lego(*paths, tick_m=0.001)
    np.testing.assert_allclose(recording.wheels.position_m[-1], [0.012, 0.010])  # right, left
    np.testing.assert_allclose(
        recording.log("laser")["ranges_m"], [[0.5, 0.6, 0.7], [0.51, np.inf, np.inf]]
    )
    # driving along x, the axle is 3 cm behind the scanner
    np.testing.assert_allclose(recording.truth.poses[0], [0.97, 1.0, 0.0], atol=1e-9)
    with pytest.raises(InputError, match="log:2: a scan of another size"):
        lego.parse_scans(words(b"S 1 2 5 5\nS 2 3 5 5 5\n"))


def test_wean():
    recording = wean.read_wean(words(samples.wean_log()))
    assert recording.log("laser")["ranges_m"].shape == (2, 180)
    assert np.isinf(recording.log("laser")["ranges_m"][0, 179])
    assert recording.sensors["laser"].mount.x_m == pytest.approx(0.25)
    np.testing.assert_allclose(recording.wheels.position_m[-1], [0.1, 0.1])
    grid = wean.read_grid(words(samples.wean_map()))
    np.testing.assert_array_equal(grid.values, [[np.nan, 0.5, 1.0], [0.0, 0.25, np.nan]])
    assert grid.cell_m == pytest.approx(0.1)
    assert grid.occupancy[1, 0] == grid.grid.probability[0, 1] == 1.0


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"global_map[0]: 800000000 800000000\n1", "map:1: no "),
        (b"global_map[0]: 3 3\n1 1 1 1\n", "map:1: 3 x 3 cells are promised, 4 are there"),
        (b"global_map[0]: 1 2\n1\nx\n", "map:3: a cell must be"),
        (b"global_map[0]: 1\n", "map:1: too few words for the map's size"),
        (b"", "map:1: no "),
        (b"global_map[0]: 1 1\n7\n", "map:2: a cell must be"),
    ],
)
def test_wean_map_refused(data, reason):
    with pytest.raises(InputError, match=reason):
        wean.read_grid(split_words(data, "map"))


@needs_data
def test_real_intel_and_relations():
    folder = DATA / "intel_lab"
    recording = intel.read_intel(
        folder / "intel_raw_910.json.gz", folder / "intel_gmapping_910.json.gz"
    )
    assert recording.log("laser")["ranges_m"].shape == (910, 180)
    assert recording.duration_s == pytest.approx(2651, abs=1)
    assert len(relations.read_relations(folder / "intel.relations.gz").stamps) == 2984
    assert len(relations.read_relations(DATA / "fr079_flirt/fr079.relations.gz").stamps) == 1685


@needs_data
def test_real_mrclam():
    recording = mrclam.read_mrclam(DATA / "mrclam6/MRCLAM_Dataset6.tar.xz", 5)
    seen = recording.truth_at(recording.log("stereo").stamps)
    rows = np.repeat(np.arange(len(seen)), np.diff(recording.log("stereo").splits))
    landmark = recording.truth.world.landmarks[true_ids(recording), :2]
    off = landmark - seen[rows, :2]
    bearing = np.arctan2(off[:, 1], off[:, 0]) - seen[rows, 2]
    points = recording.log("stereo")["points_in_camera"]
    error = np.arctan2(-points[:, 0], points[:, 2]) - bearing
    error = np.angle(np.exp(1j * error))
    known = np.isfinite(error)
    # bearings within the few degrees that the data set's text tells of
    assert np.quantile(np.abs(error[known]), 0.9) < math.radians(4.0)
    # and depths too long by the few per cent that belong to each robot
    longer = points[:, 2] / (np.hypot(*off.T) * np.cos(bearing))
    assert 1.02 < np.nanmedian(longer) < 1.06


@needs_data
def test_the_range_of_mrclam_is_a_depth():
    """Relative errors are the same at all bearings, which they are not read as a range."""
    recording = mrclam.read_mrclam(DATA / "mrclam6/MRCLAM_Dataset6.tar.xz", 2)
    log = recording.log("stereo")
    seen = recording.truth_at(log.stamps)[
        np.repeat(np.arange(len(log.stamps)), np.diff(log.splits))
    ]
    off = recording.truth.world.landmarks[true_ids(recording), :2] - seen[:, :2]
    depth = log["points_in_camera"][:, 2]
    bearing = np.abs(np.arctan2(log["points_in_camera"][:, 0], depth))

    def spread(expected, shown):
        parts = [(bearing >= low) & (bearing < low + 0.1) for low in (0.0, 0.1, 0.2, 0.3, 0.4)]
        return np.ptp([np.nanmedian(shown[part] / expected[part]) for part in parts])

    away = np.hypot(*off.T)
    ahead = off[:, 0] * np.cos(seen[:, 2]) + off[:, 1] * np.sin(seen[:, 2])
    assert spread(ahead, depth) < 0.02
    assert spread(away, depth) > 0.05


@pytest.mark.parametrize("n_beams", [180, 181, 360, 361])
def test_intel_scans_of_a_whole_half_turn(tmp_path, n_beams):
    """181 beams are a degree apart, from -90 to 90 degrees; 180 end a degree before."""
    scan = {"range": [2.0] * n_beams, "x": 0.0, "y": 0.0, "theta": 0.0}
    entries = {"1.0": scan, "2.0": {**scan, "x": 0.1}}
    path = write(tmp_path / "raw.json", json.dumps({"map": entries}).encode())
    laser = intel.read_intel(path).sensors["laser"]
    bearings = np.degrees(laser.bearings_rad + laser.mount.yaw_rad)
    step = 1.0 if n_beams < 200 else 0.5
    np.testing.assert_allclose(bearings, np.arange(n_beams) * step - 90.0, atol=1e-9)


@needs_data
def test_real_lego_and_wean():
    folder = DATA / "lego_brenner"
    recording = lego.read_lego(
        folder / "robot4_motors.txt.gz",
        folder / "robot4_scan.txt.gz",
        folder / "robot4_reference.txt.gz",
        folder / "robot_arena_landmarks.txt",
    )
    assert recording.log("laser")["ranges_m"].shape == (278, 660)
    assert len(recording.truth.world.landmarks) == 6
    log = wean.read_wean(DATA / "wean_hall_mcl/robotdata1.log.gz")
    assert len(log.log("laser").stamps) == 713
    assert log.duration_s == pytest.approx(135.0, abs=0.1)
    grid = wean.read_grid(DATA / "wean_hall_mcl/wean.dat.gz")
    assert grid.values.shape == (800, 800)


@needs_data
def test_archive_with_packed_members(tmp_path):
    with tarfile.open(tmp_path / "a.tar", "w") as archive:
        for path in mrclam_folder(tmp_path).iterdir():
            archive.add(path, f"set/{path.name}")
    assert "stereo" in mrclam.read_mrclam(tmp_path / "a.tar").logs
    assert json.dumps(mrclam.read_mrclam(tmp_path / "a.tar").config)
    assert RANGES
