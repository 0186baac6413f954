"""The study of peers over real logs: who is told what, what judges, and what is refused."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from estimators.base import Estimate
from experiments import reproduce
from experiments.evaluation.relations import relation_scores
from experiments.judging.logs import freiburg, relations_of, why_missing
from experiments.judging.results import Results
from experiments.runs.calibration import Calibration, Slip, Wheels, write_calibration
from experiments.studies.installed import why_absent
from experiments.studies.peers import figures, logs, own_logs
from experiments.studies.peers.settings import CAP_M, LASER, MAP, WEAN_STARTS
from sim import se2
from sim.errors import InputError
from sim.formats.relations import Relations, write_relations
from sim.formats.tum import write_tum
from sim.recording import save
from sim.sensors import Laser, Mount
from sim.worlds.grid import OccupancyGrid
from tests.fixtures import fakes

PEERS = ("small_gicp_keyframe_tuned", "kiss_icp_tuned", "karto", "mrpt_icp_tuned")
N_FRAMES = 700
ROOT = Path(__file__).resolve().parents[3]


def logged(n_frames=450, seed=1):
    """A log of two rounds through a room, as a stranger's: with a laser alone, without truth."""
    made = fakes.circle(seed, n_frames=n_frames)
    truth = made.truth
    sensors = {name: made.sensors[name] for name in ("encoder", "laser")}
    own = dataclasses.replace(
        made, sensors=sensors, logs={"laser": made.logs["laser"]}, truth=None, config={}
    )
    return own, truth


def true_relations(truth, step=40):
    ends = np.arange(0, len(truth.stamps) - step, 7)
    motion = se2.between(truth.poses[ends], truth.poses[ends + step])
    return Relations(np.column_stack([truth.stamps[ends], truth.stamps[ends + step]]), motion)


@pytest.fixture
def folder(tmp_path):
    own, truth = logged()
    save(own, tmp_path / "room.npz")
    write_relations(tmp_path / "room.relations", true_relations(truth))
    save(own, tmp_path / "hall.npz")
    write_tum(tmp_path / "hall.tum", truth.stamps, truth.poses)
    (tmp_path / "README.md").write_text("two logs\n")
    wheels = Wheels(gain_right=1.0, gain_left=1.0, track_m=0.19, delay_s=0.0)
    robot = Calibration(wheels, Slip(kr=1e-5, kl=1e-5, forward_slip_m=0.0))
    for name in ("room", "hall"):  # a circle does not show what calibrates a robot
        write_calibration(tmp_path / f"{name}.yaml", robot, {})
    return tmp_path


COMPOSED = {}  # methods by what they believe, since composing them takes seconds


def methods(case, *names):
    slip = case.calibration.slip
    if slip.kr not in COMPOSED:
        COMPOSED[slip.kr] = list(logs.methods_of(case))
    return iter([one for one in COMPOSED[slip.kr] if one.estimator_name in names])


@pytest.mark.slow
def test_a_users_folder_of_logs(folder):
    assert [path.name for path in own_logs.own_logs(folder)] == ["hall.npz", "room.npz"]
    for path, kind in zip(own_logs.own_logs(folder), (logs.POSES, logs.RELATIONS), strict=True):
        case = own_logs.own_case(path)
        rows = logs.rows_of(case, methods(case, "odometry", "ekf_icp", "graph_slam"))
        assert {row["kind"] for row in rows} == {kind}
        assert [row["status"] for row in rows] == ["ok"] * 4
        best = {row["estimator"]: row for row in rows if row["answer"] == "online"}
        assert best["ekf_icp"]["error_m"] < 0.02
        assert best["ekf_icp"]["error_low_m"] <= best["ekf_icp"]["error_m"]
        assert best["ekf_icp"]["cpu_ms"] > 0.0
        # the truth goes to no method: all start from the same prior and calibration
        assert kind == logs.POSES or case.recording.truth is None


@pytest.mark.slow
def test_every_method_believes_the_calibrated_noise(folder):
    case = own_logs.own_case(folder / "room.npz")
    methods(case)
    slip = case.calibration.slip
    told = [one for one in COMPOSED[slip.kr] if one.believed_slip is not None]
    assert len(told) >= 4
    assert {one.believed_slip for one in told} == {(slip.kr, slip.kl)}


def test_its_errors_are_those_of_the_metric(folder):
    case = own_logs.own_case(folder / "room.npz")
    drifting = case.prior.mean + np.linspace(0.0, 0.3, len(case.recording.frame_stamps))[:, None]
    path = Estimate(case.recording.frame_stamps, drifting, np.zeros((len(drifting), 3, 3)))
    found = logs.errors_of(case, path)
    moved = se2.compose(drifting, case.T_base_judged)
    expected = relation_scores(case.recording, case.relations, path.stamps, moved)
    assert found.translation_m.mean() == pytest.approx(expected["relation_translation_m"])
    assert found.rotation_rad.mean() == pytest.approx(expected["relation_rotation_rad"])


def test_evo_finds_the_same_errors(folder):
    """The mean position error by reference poses is what evo calls it."""
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core.trajectory import PoseTrajectory3D

    case = own_logs.own_case(folder / "hall.npz")
    for one in methods(case, "odometry", "ekf_icp", "icp_odometry", "graph_slam", "small_gicp"):
        if why_absent(one):
            continue
        rng = np.random.default_rng(0)
        path, _ = logs.run_over(case.recording, one.estimator(), case.prior, rng)
        found = logs.errors_of(case, path)
        poses = se2.compose(path.means, case.T_base_judged)
        truth = case.recording.truth_at(path.stamps)
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data(
            tuple(
                PoseTrajectory3D(
                    positions_xyz=np.column_stack([p[:, :2], np.zeros(len(p))]),
                    orientations_quat_wxyz=np.column_stack(
                        [np.cos(p[:, 2] / 2), np.zeros((len(p), 2)), np.sin(p[:, 2] / 2)]
                    ),
                    timestamps=path.stamps,
                )
                for p in (truth, poses)
            )
        )
        mean_m = ape.get_statistic(metrics.StatisticsType.mean)
        assert found.translation_m.mean() == pytest.approx(mean_m, abs=1e-9)


def test_a_bad_folder_or_log_is_one_line_with_its_remedy(tmp_path, folder):
    for wrong, said in {
        folder / "room.npz": "not a folder; name one that holds logs",
        tmp_path / "nowhere": "not a folder; name one that holds logs",
    }.items():
        with pytest.raises(InputError, match=said):
            own_logs.own_logs(wrong)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="holds no logs; put logs there"):
        own_logs.own_logs(empty)
    empty.rmdir()
    (folder / "shopping.csv").write_text("milk\n")
    with pytest.raises(InputError, match=r"shopping.csv: not a log .* move it out of the folder"):
        own_logs.over_folder(folder, lambda _: None)
    (folder / "room.yaml").unlink()
    with pytest.raises(InputError, match=r"room.npz: cannot be calibrated .*room.yaml of `estima"):
        own_logs.own_case(folder / "room.npz")
    (folder / "room.relations").unlink()
    with pytest.raises(InputError, match=r"room.npz: .*put room.relations or room.tum beside it"):
        own_logs.own_case(folder / "room.npz")
    with pytest.raises(InputError, match="mcl_office runs over no folder of logs; peers does"):
        reproduce.reproduce_over("mcl_office", folder)


def test_a_method_that_fails_has_a_row_with_the_reason(folder, monkeypatch):
    case = own_logs.own_case(folder / "room.npz")

    def broken(*_, **__):
        raise RuntimeError("out of luck")

    monkeypatch.setattr(logs, "run_over", broken)
    (row,) = logs.rows_of(case, methods(case, "odometry"))
    assert (row["status"], row["reason"], row["level"]) == ("failed", "out of luck", False)


def test_ties():
    rng = np.random.default_rng(0)
    stamps, hard_m = np.linspace(0.0, 1200.0, 400), 0.1 * rng.random(400)

    def of(error_m):
        return logs.Errors(np.arange(400), stamps, hard_m + error_m)

    board = [
        ({"estimator": "worse"}, of(0.03 + 0.001 * rng.standard_normal(400))),
        ({"estimator": "lost"}, None),
        ({"estimator": "best"}, of(np.zeros(400))),
        ({"estimator": "as good"}, of(0.001 + 0.1 * rng.standard_normal(400))),
    ]
    found = [(row["estimator"], part["level"]) for row, part in logs._ranked(board)]
    assert sorted(found[:2]) == [("as good", True), ("best", True)]
    assert found[2:] == [("worse", False), ("lost", False)]


def test_two_blocks_decide_nothing():
    assert logs._interval(np.ones(3), np.zeros(3)) == (-math.inf, math.inf)


def test_beams_off_the_walls_of_a_map():
    """A laser 1 m from a wall: at the right place all beams end in it, 0.3 m behind none does."""
    probability = np.zeros((60, 60), np.float32)
    probability[:, 40] = 1.0  # x from 4.0 to 4.1 m
    grid = OccupancyGrid(probability, 0.1)
    laser = Laser(rate_hz=10.0, n_beams=5, fov_rad=0.4, mount=Mount())
    ranges_m = 1.0 / np.cos(laser.bearings_rad)[None].repeat(3, axis=0)
    poses = np.array([[3.05, 3.0, 0.0], [2.75, 3.0, 0.0], [90.0, 3.0, 0.0]])
    walls = logs._wall_distance_m(grid)
    off = logs._misfit_m(walls, grid, laser, ranges_m, poses)
    assert off == pytest.approx([0.0, 0.3, CAP_M])


def test_the_starts_in_wean_hall_are_those_of_real_logs():
    fits = pd.read_csv(ROOT / "results" / "tables" / "real_logs_wean.csv")
    right = fits[(fits["one_means"] == "free") & ~fits["mirrored"]].set_index("log")
    for number, start in WEAN_STARTS.items():
        assert tuple(right.loc[number, ["x_m", "y_m", "yaw_rad"]]) == pytest.approx(start)


@pytest.fixture(scope="module")
def part_of_fr079():
    if why := why_missing():
        pytest.skip(why)
    whole = freiburg()
    part = dataclasses.replace(whole.cut(N_FRAMES), truth=None)
    ends = part.frame_stamps[-1]
    scans = part.logs["laser"]
    kept = scans.stamps <= ends
    short = dataclasses.replace(
        scans,
        stamps=scans.stamps[kept],
        values={name: values[kept] for name, values in scans.values.items()},
    )
    part = dataclasses.replace(part, logs={"laser": short})
    return logs.case_by_scans("fr079", part, relations_of("fr079"))


def error_m(case, name):
    rows = logs.rows_of(case, methods(case, name))
    if rows[0]["status"] == "missing":
        pytest.skip(rows[0]["reason"])
    return rows[0].get("error_m", math.inf)


@pytest.mark.slow
@pytest.mark.parametrize("name", PEERS)
def test_a_planted_fault_worsens_a_peer_on_a_real_log(name, part_of_fr079):
    """A laser that is believed to be turned, and scans whose beams run the other way."""
    right = part_of_fr079
    recording, scans = right.recording, right.recording.logs["laser"]
    laser = recording.sensors["laser"]
    turned = dataclasses.replace(
        laser, mount=dataclasses.replace(laser.mount, yaw_rad=laser.mount.yaw_rad + 0.6)
    )
    reversed_m = scans["ranges_m"][:, ::-1].copy()
    faulty = {
        "mount": {"sensors": {**recording.sensors, "laser": turned}},
        "reversed": {
            "logs": {"laser": dataclasses.replace(scans, values={"ranges_m": reversed_m})}
        },
    }
    expected_m = error_m(right, name)
    for fault, changed in faulty.items():
        wrong = dataclasses.replace(recording, **changed)
        prior = dataclasses.replace(right.prior, sensors=wrong.sensors)
        case = dataclasses.replace(right, recording=wrong, prior=prior)
        assert error_m(case, name) > 2.0 * expected_m, fault


def label(row):
    """How the documentation calls a row of the table."""
    name, *words = figures._label(row).removesuffix(" (map)").split(", ")
    mapped = " (map)" if row["sensor"] == MAP else ""
    revised = ["revised"] if row["answer"] == "revised" else []
    return ", ".join([f"`{name}`", *words, *revised]) + mapped


def cell(row):
    """An error as the documentation gives it, bold if it is level with the best of its board."""
    if not math.isfinite(row["error_m"]):
        return "failed"
    error = f"{row['error_m']:.3f}" if row["error_m"] < 1.0 else f"{row['error_m']:.1f}"
    return f"**{error}**" if row["level"] else error


def markdown_of(table):
    """The tables of docs/programs.md: a row a method, a column a log."""
    lines = []
    for lasers in (True, False):
        part = table[(table["sensor"] != "landmarks") == lasers]
        names = list(dict.fromkeys(part["log"]))
        found = {name: {} for name in names}
        order = {}
        for _, row in part.iterrows():
            found[row["log"]][label(row)] = cell(row)
            order.setdefault(label(row), []).append(math.log(row["error_m"]))
        # the best first, as means of the logs; those on a map and the failed last
        means = {key: np.nanmean(v) if np.isfinite(v).any() else 99.0 for key, v in order.items()}
        mapped = {key: "(map)" in key for key in order}
        lines += ["", f"| method | {' | '.join(names)} |", "| --- |" + " --- |" * len(names)]
        for key in sorted(order, key=lambda key: (mapped[key], means[key])):
            lines.append(f"| {key} | " + " | ".join(found[n].get(key, "") for n in names) + " |")
    return "\n".join(lines[1:]) + "\n"


def test_the_documentation_has_the_table():
    table = pd.read_csv(ROOT / "results" / "tables" / "peers_logs.csv")
    text = (ROOT / "docs" / "programs.md").read_text(encoding="utf-8")
    assert markdown_of(table) in text
    theirs = table[table["estimator"].str.startswith("gtsam")]
    assert set(theirs["status"]) == {"failed"}
    assert theirs["reason"].str.startswith("Indeterminate linear system").all()


def test_its_figure(tmp_path):
    rows = [
        {
            "log": log,
            "sensor": LASER if log != "landmarks 1" else "landmarks",
            "answer": answer,
            "estimator": name,
            "arm": arm,
            "kind": "relations",
            "status": "ok" if error_m else "failed",
            "level": error_m == 0.02,
            "error_m": error_m or math.nan,
            "error_low_m": error_m,
            "error_high_m": 2.0 * error_m,
        }
        for log in ("intel", "landmarks 1")
        for name, arm, answer, error_m in (
            ("ekf_icp", "informed", "online", 0.02),
            ("graph_slam", "informed", "revised", 0.03),
            ("kiss_icp_tuned", "tuned", "online", 0.05),
            ("karto", "shipped", "online", 0.0),
        )
    ]
    made = Results(tmp_path, "peers")
    made.write_tables(logs=pd.DataFrame(rows))
    (page,) = figures.draw(made).values()
    labels = [[t.get_text() for t in axes.get_xticklabels()] for axes in page.axes]
    expected = ["ekf_icp", "graph_slam, revised", "kiss_icp, tuned", "karto, shipped"]
    assert labels == [expected, expected]
    assert [axes.get_ylabel() for axes in page.axes] == [
        "intel\nrelations, m",
        "landmarks 1\nrelations, m",
    ]
    assert {axes.get_yscale() for axes in page.axes} == {"log"}
