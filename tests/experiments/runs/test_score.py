import dataclasses
import json

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.metrics import PoseRelation, Unit
from evo.core.trajectory import PoseTrajectory3D

from estimators.base import Estimate
from experiments.cli import main as cli
from experiments.evaluation.relations import relation_scores
from experiments.runs.score import Scoring, describe_scoring, error_table, match_and_align
from experiments.trajectories.convert import write_estimate
from experiments.trajectories.read import read_trajectory
from experiments.viewing.compare import reference_of
from sim import se2
from sim.errors import InputError
from sim.formats.relations import Relations, write_relations
from sim.formats.trajectory import read_track, sound_covariances
from sim.recording import load, save
from tests.fixtures import fakes
from tests.fixtures.fakes import circle

_EVO = ("rmse", "mean", "median", "std", "min", "max", "sse")


def drive(seed, n=300):
    """A truth at 10 Hz; an estimate of it that drifts, with gaps and an offset of its clock."""
    rng = np.random.default_rng(seed)
    steps = np.column_stack([np.full(n, 0.1037), np.zeros(n), 0.15 * rng.standard_normal(n)])
    truth = se2.chain(steps, np.array([3.0, -2.0, 1.0]))
    stamps = 1e3 + 0.1 * np.arange(len(truth))
    drift = np.array([0.004, 0.002, 0.01]) * rng.standard_normal((n, 3))
    means = se2.chain(steps + drift, np.array([3.2, -2.1, 1.2]))
    kept = rng.random(len(truth)) > 0.05 * (seed % 3)
    kept[100 : 100 + 10 * (seed % 4)] = False
    clock = stamps + 0.25 * (seed % 2) + 0.004 * (rng.random(len(stamps)) - 0.5)
    return stamps, truth, clock[kept], means[kept]


def for_evo(stamps, poses):
    quaternion = np.zeros((len(poses), 4))
    quaternion[:, 0], quaternion[:, 3] = np.cos(poses[:, 2] / 2), np.sin(poses[:, 2] / 2)
    positions = np.column_stack([poses[:, :2], np.zeros(len(poses))])
    return PoseTrajectory3D(positions, quaternion, stamps)


def evo_table(reference, estimate, align, offset_s):
    """What evo_ape and evo_rpe --pairs_from_reference print."""
    reference, estimate = sync.associate_trajectories(
        reference, estimate, max_diff=0.01, offset_2=offset_s
    )
    if align == "start":
        estimate.align_origin(reference)
    elif align == "se2":
        estimate.align(reference, correct_scale=False)
    found = {}
    for relation, name in (
        (PoseRelation.translation_part, "position"),
        (PoseRelation.rotation_angle_rad, "heading"),
    ):
        unit = "m" if name == "position" else "rad"
        kinds = {f"{name} error, {unit}": evo_metrics.APE(relation)}
        for metres in (1, 10):
            kinds[f"{name} over {metres} m, {unit}"] = evo_metrics.RPE(
                relation, metres, Unit.meters, pairs_from_reference=True
            )
        for key, kind in kinds.items():
            kind.process_data((reference, estimate))
            every = kind.get_all_statistics()
            found[key] = {statistic: every[statistic] for statistic in _EVO}
    return found


@pytest.mark.parametrize("seed", range(10))
def test_figures_are_those_of_evo(seed):
    stamps, truth, clock, means = drive(seed)
    recording = reference_of(Estimate(stamps, truth, np.zeros((len(stamps), 3, 3))))
    given = Estimate(clock, means, np.zeros((len(clock), 3, 3)))
    offset_s = -0.25 * (seed % 2)
    for align in ("none", "start", "se2"):
        how = Scoring(align=align, match="nearest", offset_s=offset_s)
        ours = error_table(match_and_align(recording, given, how))
        theirs = evo_table(for_evo(stamps, truth), for_evo(clock, means), align, offset_s)
        assert ours.keys() == theirs.keys()
        for error, values in theirs.items():
            assert ours[error] == pytest.approx(values, abs=1e-9, rel=1e-9), (error, align)


@pytest.mark.parametrize("n", [99, 100, 101])
def test_of_equally_many_poses_the_pairs_are_those_of_evo(n):
    stamps, truth, *_ = drive(0)
    rng = np.random.default_rng(n)
    clock = np.sort(stamps[0] + 10.0 * rng.random(n))
    means = truth[np.searchsorted(stamps, clock)] + 0.1 * rng.standard_normal((n, 3))
    zeros = np.zeros((100, 3, 3))
    recording = reference_of(Estimate(stamps[:100], truth[:100], zeros))
    scored = match_and_align(
        recording, Estimate(clock, means, np.zeros((n, 3, 3))), Scoring(match="nearest")
    )
    reference, estimate = sync.associate_trajectories(
        for_evo(stamps[:100], truth[:100]), for_evo(clock, means), max_diff=0.01
    )
    assert np.array_equal(scored.estimate.stamps, estimate.timestamps)
    assert np.array_equal(scored.truth[:, :2], reference.positions_xyz[:, :2])


def test_a_pose_that_is_scored_twice_is_counted():
    stamps, truth, *_ = drive(0)
    recording = reference_of(Estimate(stamps[:3], truth[:3], np.zeros((3, 3, 3))))
    clock = stamps[0] + np.array([0.0, 0.3, 0.4, 0.5])
    given = Estimate(clock, truth[:4], np.zeros((4, 3, 3)))
    how = Scoring(match="nearest", tolerance_s=0.12)
    said = describe_scoring(match_and_align(recording, given, how), how)
    assert "4 poses, 3 scored (1 of them again, with another true stamp)" in said
    assert "2 left out" in said


def test_what_was_scored_is_said():
    stamps, truth, _, _ = drive(0)
    recording = reference_of(Estimate(stamps, truth, np.zeros((len(stamps), 3, 3))))
    late = Estimate(
        stamps[50:100] + 7.0, truth[50:100], np.tile(np.eye(3), (50, 1, 1)), kind="online"
    )
    scored = match_and_align(recording, late, Scoring(offset_s=-7.0))
    assert scored.n_given == len(scored.truth) == 50
    assert scored.longest_gap_s == pytest.approx(stamps[-1] - stamps[99])
    assert error_table(scored)["position error, m"]["max"] < 1e-6
    outside = match_and_align(
        recording, late, Scoring(offset_s=float(stamps[-1] - stamps[80]) - 7.0)
    )
    assert (len(outside.truth), outside.n_left_out) == (31, 19)
    turned = match_and_align(
        recording,
        Estimate(late.stamps - 7.0, se2.compose(np.array([1.0, 2.0, np.pi / 2]), late.means),
                 np.tile(np.diag([4.0, 1.0, 1.0]), (50, 1, 1))),
        Scoring(align="start"),
    )  # fmt: skip
    assert turned.moved_by[2] == pytest.approx(-np.pi / 2)
    assert turned.estimate.covariances[0] == pytest.approx(np.diag([1.0, 4.0, 1.0]))
    with pytest.raises(InputError, match=r"0 of 50 poses meet the truth.*set an offset"):
        match_and_align(recording, late, Scoring(offset_s=1e4))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A recording with a truth, and one estimate of it in three formats."""
    folder = tmp_path_factory.mktemp("score")
    recording = fakes.circle()
    save(recording, folder / "run.npz")
    stamps = recording.frame_stamps
    poses = recording.truth_at(stamps) + np.array([0.1, -0.05, 0.02])
    estimate = Estimate(stamps, poses, np.tile(np.diag([0.02, 0.01, 4e-4]), (len(stamps), 1, 1)))
    for ending in ("tum", "csv", "mcap"):
        write_estimate(folder / f"est.{ending}", estimate)
    return folder, estimate


def test_a_tum_file_may_hold_covariances(tmp_path):
    path = tmp_path / "known.tum"
    pose = "1 2 0 0 0 0 1"
    path.write_text(f"0 {pose} 4 1 0.5 9 0.25 1\n1 {pose}\n")
    covariances = read_track(path).covariances
    np.testing.assert_array_equal(covariances[0], [[4, 1, 0.5], [1, 9, 0.25], [0.5, 0.25, 1]])
    assert not covariances[1].any()
    for words, complaint in (("4 1 0.5 9 0.25", ":1: a line must be"), ("4 9 0 4 0 1", "pose 1")):
        path.write_text(f"0 {pose} {words}\n")
        with pytest.raises(InputError, match=complaint):
            read_track(path)


@pytest.mark.parametrize("ending", ["tum", "csv", "mcap"])
def test_each_format_is_read_back(files, ending):
    folder, estimate = files
    found = read_trajectory(folder / f"est.{ending}")
    assert np.allclose(found.stamps, estimate.stamps, atol=1e-9)
    assert np.allclose(found.means, estimate.means, atol=1e-12)
    wanted = np.zeros_like(estimate.covariances) if ending == "tum" else estimate.covariances
    assert np.allclose(found.covariances, wanted)


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr("sys.argv", ["estima", *map(str, arguments)])
    code = 0
    try:
        cli.main()
    except SystemExit as ended:
        code = ended.code or 0
    return code, *capsys.readouterr()


def test_a_row_is_an_ordinary_one(files, tmp_path, monkeypatch, capsys):
    folder, estimate = files
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    log = folder / "run.npz"
    code, out, err = run(
        monkeypatch, capsys, "score", log, folder / "est.csv", "--cpu-seconds", "2", "--json"
    )
    assert code == 0, err
    (row,) = json.loads(out)
    assert row["ate_rmse_m"] == pytest.approx(np.hypot(0.1, 0.05))
    assert row["heading_rmse_rad"] == pytest.approx(0.02)
    assert row["nees_mean"] == pytest.approx(0.01 / 0.02 + 0.0025 / 0.01 + 4e-4 / 4e-4)
    assert row["cpu_time_us"] == pytest.approx(2e6 / len(estimate.stamps))
    code, out, err = run(
        monkeypatch, capsys, "score", log, folder / "est.tum", "--revised", "--as", "batch"
    )
    assert code == 0, err
    assert "revised path, not aligned" in out
    code, out, err = run(monkeypatch, capsys, "table", "score", "--times")
    assert code == 0, err
    assert [line.split()[:3] for line in out.splitlines()[3:5]] == [
        ["batch", "1", "revised"],
        ["est", "1", "online"],
    ]
    picture = tmp_path / "plot.png"
    code, _, err = run(
        monkeypatch, capsys, "plot", "score", "--x", "choice.estimator", "-o", picture
    )
    assert (code, picture.exists()) == (0, True), err


def test_a_trajectory_that_leaves_out_much_gets_a_remark(files, tmp_path, monkeypatch, capsys):
    folder, _ = files
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    three = tmp_path / "three.tum"
    three.write_text("\n".join((folder / "est.tum").read_text().splitlines()[:3]) + "\n")
    found = {}
    for path in (three, folder / "est.tum"):
        code, out, err = run(monkeypatch, capsys, "score", folder / "run.npz", path, "--json")
        assert code == 0, err
        (row,) = json.loads(out)
        found[path.stem] = (row["status"], row["status_code"])
    assert found == {"three": ("remark", "gap"), "est": ("ok", "")}


@pytest.mark.parametrize("left", [False, True])
def test_what_is_not_planar_is_said(files, tmp_path, monkeypatch, capsys, left):
    folder, _ = files
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    lines = (folder / "est.tum").read_text().splitlines()
    height = (i * 3.0 / (len(lines) - 1) if left else 3.0 for i in range(len(lines)))
    turn = "0 0.7071 0 0.7071" if left else "0 0 0 1"
    steep = [" ".join([*a.split()[:3], f"{z}", turn]) for a, z in zip(lines, height, strict=True)]
    path = tmp_path / "steep.tum"
    path.write_text("\n".join(steep) + "\n")
    code, out, err = run(monkeypatch, capsys, "score", folder / "run.npz", path)
    assert code == 0, err
    said = "roll and pitch up to 90 degrees and 3 m of height are left out: scores are planar"
    assert (said in out) == left  # a constant height is none
    code, out, _ = run(monkeypatch, capsys, "score", folder / "run.npz", path, "--json")
    assert json.loads(out)[0]["status_code"] == ("planar" if left else "")


def test_trajectories_are_compared(files, tmp_path, monkeypatch, capsys):
    folder, _ = files
    monkeypatch.chdir(tmp_path)
    both = (folder / "est.tum", folder / "est.mcap")
    code, out, err = run(monkeypatch, capsys, "compare", *both, "--recording", folder / "run.npz")
    assert code == 0, err
    assert len(out.splitlines()) == 4
    assert "0.1118" in out
    code, out, _ = run(monkeypatch, capsys, "compare", *both, "-o", "b.png")
    assert (code, (tmp_path / "b.png").exists()) == (0, True)
    code, _, err = run(monkeypatch, capsys, "compare", both[0])
    assert (code, len(err.splitlines())) == (2, 1)


def test_an_estimate_is_converted_and_run_writes_it(files, tmp_path, monkeypatch, capsys):
    folder, estimate = files
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    for source, options in (("est.csv", ()), ("est.mcap", ("--topic", "estimate"))):
        out = tmp_path / f"{source}.tum"
        code, _, err = run(monkeypatch, capsys, "convert", folder / source, *options, "-o", out)
        assert code == 0, err
        assert np.allclose(read_trajectory(out).means, estimate.means, atol=1e-12)
    out = tmp_path / "own.tum"
    settings = ("estimator=odometry", "picture=false", f"recording='{folder / 'run.npz'}'")
    code, text, err = run(monkeypatch, capsys, "run", *settings, "-o", out)
    assert code == 0, err
    assert "own.tum" in text
    assert len(read_trajectory(out).stamps) == len(estimate.stamps)
    for wrong in (("-o", "est.xyz"), ("-m", "seed=1,2", "-o", "est.tum")):
        code, _, err = run(monkeypatch, capsys, "run", *settings, *wrong)
        assert (code, len(err.splitlines())) == (2, 1)


_LINE = "{} 1 2 0 0 0 0 1\n"
_CSV = "header.stamp,pose.position.x,pose.position.y,pose.orientation.z,pose.orientation.w," + (
    ",".join(f"pose.covariance.{i}" for i in range(36)) + "\n"
)
_ROW = "{},1,2,0,1," + ",".join(["0"] * 36) + "\n"
MALFORMED = {
    "empty.tum": b"",
    "blank.tum": b"\n\n",
    "comment.tum": b"# timestamp tx ty tz qx qy qz qw\n",
    "seven.tum": b"0 1 2 0 0 0 1\n",
    "nine.tum": b"0 1 2 0 0 0 0 1 5\n",
    "words.tum": b"0 1 two 0 0 0 0 1\n",
    "nan.tum": b"0 1 nan 0 0 0 0 1\n",
    "inf.tum": b"0 inf 2 0 0 0 0 1\n",
    "stamp.tum": b"nan 1 2 0 0 0 0 1\n",
    "quaternion.tum": b"0 1 2 0 0 0 0 0\n",
    "long.tum": b"0 1 2 0 9 0 0 1\n",
    "far.tum": b"0 1e300 2 0 0 0 0 1\n",
    "huge.tum": b"1e300 1e300 2 0 0 0 0 1\n",
    "backwards.tum": (_LINE.format(1) + _LINE.format(0)).encode(),
    "twice.tum": (_LINE.format(1) * 2).encode(),
    "nanoseconds.tum": _LINE.format("1700000000000000000").encode(),
    "elsewhere.tum": _LINE.format(1e6).encode(),
    "binary.tum": bytes(range(256)),
    "utf16.tum": _LINE.format(0).encode("utf-16"),
    "mark.tum": "\ufeff".encode(),
    "cut.tum": (_LINE.format(0) + "0.1 1 2").encode(),
    "empty.csv": b"",
    "header.csv": _CSV.encode(),
    "other.csv": b"t,x,y\n0,1,2\n",
    "short.csv": (_CSV + "0,1,2\n").encode(),
    "word.csv": (_CSV + _ROW.format("zero")).encode(),
    "nan.csv": (_CSV + _ROW.format("nan")).encode(),
    "zero.csv": (_CSV + _ROW.format(0).replace(",0,1,", ",0,0,", 1)).encode(),
    "backwards.csv": (_CSV + _ROW.format(1) + _ROW.format(0)).encode(),
    "binary.csv": b"\xff\xfe\x00header.stamp",
    "nul.csv": (_CSV + _ROW.format(0)).encode() + b"\x00\x00\n",
    "one.tum": _LINE.format(0.5).encode(),
    "meets_once.tum": "".join(_LINE.format(i * 100_000_000) for i in range(9)).encode(),
    "negated.csv": (_CSV + "".join(_ROW.format(0.1 * i - 0.8) for i in range(9))).encode(),
    "variance.csv": (_CSV + _ROW.format(0).replace(",0,1,0", ",0,1,-1e-4", 1)).encode(),
    "nan_covariance.csv": (_CSV + _ROW.format(0).replace(",0,1,0", ",0,1,nan", 1)).encode(),
    "asymmetric.csv": (_CSV + _ROW.format(0).replace(",0,1,0,0", ",0,1,1,0.5", 1)).encode(),
    "cut.csv": (_CSV + _ROW.format(0) + "0.1,1,2,0,1,0,0").encode(),
    "empty.mcap": b"",
    "magic.mcap": b"\x89MCAP0\r\n",
    "noise.mcap": b"\x89MCAP0\r\n" + bytes(range(256)) * 4,
    "noise.bag": b"#ROSBAG V2.0\n" + bytes(range(256)),
    "noise.db3": b"SQLite format 3\x00" + bytes(100),
}


@pytest.mark.parametrize("name", [*MALFORMED, "missing.tum", "folder.tum", "cut.mcap"])
def test_malformed_trajectories_end_in_one_line(files, tmp_path, monkeypatch, capsys, name):
    path = tmp_path / name
    if name == "folder.tum":
        path.mkdir()
    elif name == "cut.mcap":
        path.write_bytes((files[0] / "est.mcap").read_bytes()[:2000])
    elif name in MALFORMED:
        path.write_bytes(MALFORMED[name])
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    code, out, err = run(monkeypatch, capsys, "score", files[0] / "run.npz", path)
    assert (code, out) == (2, ""), err
    assert err.startswith("estima: ")
    assert name in err
    assert len(err.splitlines()) == 1


def test_a_byte_order_mark_before_a_csv_is_passed_over(files, tmp_path):
    plain, marked = files[0] / "est.csv", tmp_path / "est.csv"
    marked.write_bytes(b"\xef\xbb\xbf" + plain.read_bytes())
    assert np.array_equal(read_trajectory(marked).means, read_trajectory(plain).means)


def test_messages_say_what_is_wrong(tmp_path):
    (tmp_path / "dir.tum").mkdir()
    (tmp_path / "cut.csv").write_bytes(MALFORMED["cut.csv"])
    for name, message in (
        ("dir.tum", "is a folder"),
        ("missing.tum", "no such file"),
        ("cut.csv", r"cut\.csv:3: the line ends before pose\.covariance\.2; is it cut off"),
    ):
        with pytest.raises(InputError, match=message):
            read_trajectory(tmp_path / name)


def test_unknown_covariances_of_odometry_are_minus_one(tmp_path):
    stamps, poses = np.arange(3.0), np.zeros((3, 3))
    path = tmp_path / "odom.mcap"
    write_estimate(path, Estimate(stamps, poses, np.tile(-np.eye(3), (3, 1, 1))))
    assert not read_trajectory(path).covariances.any()
    write_estimate(path, Estimate(stamps, poses, np.tile(-0.5 * np.eye(3), (3, 1, 1))))
    with pytest.raises(InputError, match=r"odom\.mcap: the covariance of pose 1 is none"):
        read_trajectory(path)


@pytest.mark.parametrize(
    ("change", "sound"),
    [
        (np.zeros((3, 3)), True),
        (np.diag([0.0, 0.0, -1e-5]), False),
        (np.diag([np.nan, 0.0, 0.0]), False),
        (np.array([[0.0, 1e-6, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), True),
        (np.array([[0.0, 1e-3, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), False),
        (np.array([[0.0, 0.02, 0.0], [0.02, 0.0, 0.0], [0.0, 0.0, 0.0]]), False),
    ],
)
def test_a_covariance_is_sound_up_to_rounding(change, sound):
    covariance = np.diag([0.01, 0.01, 0.0]) + change
    assert sound_covariances(covariance[None])[0] == sound
    assert sound_covariances(np.zeros((1, 3, 3)))[0]


def test_options_that_make_no_sense_are_named(files, tmp_path, monkeypatch, capsys):
    folder, _ = files
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    log, one, two = (folder / name for name in ("run.npz", "est.tum", "est.csv"))
    for wrong, named in (
        ((one, "--align", "sim3"), "align must be one of none, start, se2"),
        ((one, "--match", "all"), "match must be"),
        ((one, "--tolerance", "-1"), "tolerance_s must be"),
        ((one, "--offset", "nan"), "offset_s must be a number"),
        ((one, "--cpu-seconds", "-1"), "cpu_seconds must be"),
        ((one, "--topic", "odom"), "only a bag has topics"),
        ((folder / "est.mcap", "--topic", "none"), "no nav_msgs/Odometry on none"),
        ((one, two), "two trajectories called est"),
        ((one, "--name", "a/b"), "name must be one word"),
    ):
        code, _, err = run(monkeypatch, capsys, "score", log, *wrong)
        assert code == 2
        assert named in err


def test_relations_judge_too_and_alone(files, monkeypatch, capsys, tmp_path):
    """By them a constant offset costs nothing, and no truth is needed."""
    folder, _ = files
    recording = load(folder / "run.npz")
    ends = recording.frame_stamps[[[0, 30], [10, 50], [20, 55]]]
    motion = se2.between(recording.truth_at(ends[:, 0]), recording.truth_at(ends[:, 1]))
    motion[:, 0] += 0.3
    write_relations(tmp_path / "true.relations", Relations(ends, motion))
    save(dataclasses.replace(recording, truth=None), tmp_path / "blind.npz")
    given = ("--relations", tmp_path / "true.relations", "--json", "--results", tmp_path)
    for drive, with_truth in ((folder / "run.npz", True), (tmp_path / "blind.npz", False)):
        code, out, _ = run(monkeypatch, capsys, "score", drive, folder / "est.tum", *given)
        [row] = json.loads(out)
        assert code == 0
        assert row["n_relations"] == 3
        assert row["relation_translation_m"] == pytest.approx(0.3, abs=0.05)
        assert ("ate_rmse_m" in row) == with_truth
    code, _, said = run(monkeypatch, capsys, "score", tmp_path / "blind.npz", folder / "est.tum")
    assert code == 2
    assert "no truth to score against" in said


def test_of_a_thinned_log_only_known_stamps_are_judged():
    recording = fakes.circle()
    scans = recording.log("laser").stamps
    relations = Relations(scans[[[0, 30], [10, 50]]], np.zeros((2, 3)))
    known = dataclasses.replace(recording, config={"stamps_known": [0, 30]})
    poses = recording.truth_at(scans)
    assert relation_scores(recording, relations, scans, poses)["n_relations"] == 2
    assert relation_scores(known, relations, scans, poses)["n_relations"] == 1


def test_gaps_of_the_truth_are_not_bridged():
    """As in a run: `scoring.longest_gap_s`."""
    recording = circle(n_frames=100)
    stamps = recording.known_truth.stamps
    kept = (stamps < stamps[40]) | (stamps > stamps[60])
    truth = dataclasses.replace(
        recording.known_truth, stamps=stamps[kept], poses=recording.known_truth.poses[kept]
    )
    holed = dataclasses.replace(recording, truth=truth)
    given = Estimate(stamps, recording.known_truth.poses, np.zeros((len(stamps), 3, 3)))
    gap_s = float(stamps[61] - stamps[39])
    scored = match_and_align(holed, given, Scoring(truth_gap_s=0.99 * gap_s))
    assert scored.n_left_out == 21
    assert match_and_align(holed, given, Scoring(truth_gap_s=1.01 * gap_s)).n_left_out == 0
