"""Teams by the one runner: rows, sweeps, files, the command line, pictures."""

import dataclasses

import numpy as np
import pytest

from estima import run as run_once
from estima import simulate
from experiments.evaluation.metrics import position_errors_m, rms
from experiments.gate.candidate import write_recordings
from experiments.gate.suite import draw_run, read_suite, run_suite
from experiments.runs.calibration import Calibration, Slip, Wheels, write_calibration
from experiments.runs.evaluate import evaluate, scores_of_team, status_of_team
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome, Status
from experiments.runs.seeds import stream
from experiments.sweeps.collect import collect
from experiments.sweeps.launch import sweep
from experiments.sweeps.plan import make_plan
from experiments.viewing.animation import pictures
from experiments.viewing.estimates import with_estimates
from experiments.viewing.playback import Playback
from experiments.viewing.run_figure import run_figure
from sim import recording as recordings
from sim import team as teams
from sim.errors import InputError
from tests.experiments.cli.test_cli import called as command
from tests.experiments.cli.test_cli import refused

SHORT = ("study=teams", "seed=5", "route.distance_m=3", "team.size=2", "estimator=ekf_slam")
APART = "team.communication={kind: range, range_m: 0.01, delay_s: null}"


def composed(*overrides):
    return Experiment.compose([*SHORT, *overrides])


@pytest.fixture(autouse=True)
def _own_results(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path / "results"))


def test_a_run_of_a_team_is_one_row_of_pooled_errors():
    found = []
    [row] = evaluate(composed(), on_estimate=lambda *one: found.append(one))
    assert row["status"] == "ok", row["status_detail"]
    off = [position_errors_m(own.truth_at(e.stamps), e.means) for own, _, e, _ in found]
    assert len(off) == 2
    assert row["ate_rmse_m"] == pytest.approx(rms(np.concatenate(off)))
    assert row["worst_robot_rmse_m"] == pytest.approx(max(map(rms, off)))
    assert row["stamps_scored"] == sum(map(len, off))
    assert row["n_sightings"] == sum(len(own.log("robots")["ids"]) for own, *_ in found) > 0
    assert row["step_time_us"] > 0.0 < row["cpu_time_us"]
    assert (row["team.size"], row["team.communication.kind"]) == (2, "always")


def test_sums_squares_and_means_of_scores():
    team = composed().recordings()
    row = scores_of_team(
        team,
        [
            {"ate_rmse_m": 3.0, "stamps_scored": 1.0, "nees_mean": 1.0, "step_time_us": 5.0},
            {"ate_rmse_m": 1.0, "stamps_scored": 3.0, "nees_mean": 5.0, "step_time_us": 7.0,
             "revised_ate_rmse_m": 0.5},
        ],
    )  # fmt: skip
    assert row["ate_rmse_m"] == pytest.approx(np.sqrt((9.0 + 3.0) / 4.0))
    assert row["nees_mean"] == pytest.approx(4.0)
    assert row["step_time_us"] == 12.0
    assert row["worst_robot_rmse_m"] == 3.0


def test_the_worst_status_is_that_of_the_team():
    bad = Status(Outcome.FAILED, "recording", "collision at 3 s")
    found = status_of_team([Status(), bad, Status(Outcome.REMARK, "gap", "no pose")])
    assert found == dataclasses.replace(bad, detail="robot 1: collision at 3 s")
    assert status_of_team([Status(), Status()]) == Status()


def test_a_team_of_one_has_the_scores_of_the_robot_alone():
    overrides = ("team.size=1", "estimator.robots=null")
    [of_team] = evaluate(composed(*overrides))
    [alone] = evaluate(composed(*overrides).of_robot(0))
    of_path = ("_m", "_rad", "_m2", "nees_mean", "_scored")
    same = [key for key in alone if key.endswith(of_path) and isinstance(alone[key], float)]
    assert len(same) > 8
    for key in (key for key in same if "bound" not in key):  # a team has no bound
        assert of_team[key] == pytest.approx(alone[key], rel=1e-12), key


def test_a_robot_of_unknown_start_is_scored_from_where_it_is_placed():
    [row] = evaluate(composed("team.starts=unknown", "route.distance_m=12"))
    assert np.isfinite(row["ate_rmse_m"]), row["status_detail"]
    assert row["status"] in ("ok", "remark")
    whole = evaluate(composed("route.distance_m=12"))[0]
    assert row["stamps_scored"] < whole["stamps_scored"]
    [never] = evaluate(composed("team.starts=unknown", APART, "route.distance_m=0.5"))
    assert (never["status"], never["status_code"]) == ("failed", "not_finite")
    assert never["status_detail"].startswith("robot 1: no pose at any time")


def test_a_team_is_simulated_once_and_a_smaller_one_is_another():
    first, again = composed().recordings(), composed("team.starts=unknown").recordings()
    assert first.checksum == again.checksum
    keys = [composed(o).recording_key for o in ("team.size=2", "team.size=1", "team.starts=known")]
    assert keys[0] == keys[2] != keys[1]
    assert (
        len({composed(o).key for o in ("team.size=2", "team.size=1", "team.starts=unknown")}) == 3
    )


@pytest.mark.slow
def test_sweeps_of_teams():
    lines = [*SHORT, "team.size=1,2", "seed=5,6", "estimator.robots=null,robots"]
    plan = make_plan([*lines, "estimator.kr=1e-5,5e-5"])
    keys = [int(plan.experiment(i).key, 16) for i in range(len(plan.keys))]
    assert keys == plan.keys.tolist()
    assert len(set(plan.recordings.tolist())) == 4  # by size and seed
    done = []
    sweep([*lines, "hydra/launcher=basic", "name=small"], on_done=lambda *found: done.append(found))
    ((folder, n_runs),) = done
    table = collect(str(folder))
    assert n_runs == len(table) == 8
    assert set(table["status"]) == {"ok"}
    assert table.groupby(["seed", "team.size"])["recording_checksum"].nunique().eq(1).all()
    wide = table[table["team.size"] == 2].pivot_table(
        index="seed", columns=table["estimator.robots"].notna(), values="ate_rmse_m"
    )
    assert (wide[True] != wide[False]).all()


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        (["team.size=0"], r"team\.size must be a whole number, at least 1, got 0"),
        (["team.size=40"], r"team\.size must be from 1 to the 5 of team\.robots, got 40"),
        (["team.size=two"], r"team\.size must be a whole number"),
        (["team.size=.nan"], r"team\.size must be a whole number"),
        (["team.robots=3"], r"team\.robots must be a valid list, got 3"),
        (["team.robots=[3,4]"], r"team\.robots\[0\] must be a valid dictionary, got 3"),
        (["team.robots=[{},{route: 3}]"], r"team\.robots\[1\]\.route must hold keys"),
        (
            ["team.robots=[{},{route: {wheels: 9}}]"],
            r"unknown key team\.robots\[1\]\.route\.wheels",
        ),
        (["team.starts=unknown", "team.communication.kind=never"], r"is never placed"),
        (["prior.start=global"], r"start of robot 0 must be known"),
        (["team.robots=[{},{route: {first: 9}}]"], r"route\.first must be a way-point .* got 9"),
        (["team.robots=[{},{robot: {kr: -1}}]"], r"team\.robots\[1\]: robot\.kr"),
        (["team.communication.kind=range", "team.communication.range_m=-1"], "positive number"),
        (["team.communication.kind=range", "team.communication.range_m=nan"], "holds NaN"),
        (["team.communication.kind=shouting"], "kind"),
        (["estimator=odometry"], r"estimator=odometry localizes one robot; a team takes ekf_slam"),
        (["keep=[ess]"], "keep applies to one robot"),
        (["estimator.robots=eyes"], r"estimator=ekf_slam needs a sensor eyes"),
        (["estimator=fastslam", "team.starts=unknown"], "fastslam needs the starts of all robots"),
        (["team.robots=[{},{}]"], r"robots 0 and 1 start within each other"),
    ],
)
def test_wrong_teams_are_refused_in_a_line(overrides, complaint):
    with pytest.raises(InputError, match=complaint) as error:
        evaluate(composed(*overrides))
    assert "\n" not in str(error.value)


def test_a_start_in_a_wall_says_whose():
    with pytest.raises(InputError, match="robot 1 overlaps a wall"):
        evaluate(
            composed(
                "route=explore", "sensors=laser_stereo", "route.feedback=truth",
                "team.robots=[{},{route: {start_offset_m: [2.9, 2.0]}}]", "estimator.robots=null",
            )
        )  # fmt: skip


def test_what_is_of_one_robot_refuses_a_team():
    with pytest.raises(InputError, match=r"estima\.run takes one robot"):
        run_once(*SHORT)
    with pytest.raises(InputError, match="a recording holds one robot"):
        simulate(*SHORT)


def test_files_of_teams_by_the_command_line(tmp_path):
    path, alone = tmp_path / "team.npz", tmp_path / "one.npz"
    made = command("record", *SHORT, "-o", str(path))
    assert made.returncode == 0, made.stderr
    assert "robot 1: ok" in made.stdout
    team = teams.load(path)
    [row] = evaluate(composed(f"recording={path}"))
    [simulated] = evaluate(composed())
    assert row["ate_rmse_m"] == simulated["ate_rmse_m"]
    with pytest.raises(InputError, match=r"team\.npz: a team of 2 robots; set team\.size"):
        evaluate(composed(f"recording={path}", "team.size=3"))
    with pytest.raises(InputError, match=r"team\.npz: it holds a team; run all"):
        evaluate(Experiment.compose([f"recording={path}"]))
    assert command("convert", str(path), "--robot", "1", "-o", str(alone)).returncode == 0
    assert recordings.load(alone).checksum == team.robots[1].checksum
    with pytest.raises(InputError, match=r"one\.npz: a team of 1 robots; set team\.size"):
        evaluate(composed(f"recording={alone}"))
    told = command("info", str(path)).stdout
    assert "robot 0" in told
    assert "robot 1" in told
    for words, complaint in (
        (["convert", str(path), "-o", "x.mcap"], "it holds a team"),
        (["convert", str(path), "--robot", "2", "-o", "x.mcap"], "its robots are 0 to 1, got 2"),
        (["convert", str(path), "--team", "-o", "x.npz"], "not an MRCLAM set"),
        (["score", str(path), "x.tum"], "it holds a team"),
        (["map", str(path), "-o", "x.yaml"], "it holds a team"),
        (["calibrate", str(path), "-o", "x.yaml"], "it holds a team"),
        (["view", str(path)], "a team is drawn in files"),
        (["view", str(path), "-e", "odometry", "-o", "x.html"], "localizes one robot"),
        (["run", *SHORT, "-o", "x.tum"], "one file holds one robot"),
    ):
        refused(command(*words), complaint)


def test_pictures_of_a_team(tmp_path):
    team, found = composed().recordings(), []
    evaluate(composed(), lambda: team, on_estimate=lambda own, _, e, __: found.append((own, e)))
    run_figure(found, "ekf_slam").savefig(tmp_path / "team.png")
    shown = Playback.of(team, 4)
    bare = list(pictures(shown))
    assert len(bare) == len(shown.stamps) == 4
    assert not np.array_equal(bare[0], bare[-1])
    seeing = with_estimates(shown, "ekf_slam", [], lambda _: None)
    assert seeing.name == "ekf_slam"
    assert not np.array_equal(bare[-1], list(pictures(seeing))[-1])


@pytest.mark.slow
def test_a_suite_may_hold_a_team(tmp_path):
    path = tmp_path / "mine.yaml"
    lines = ["study=teams", "team.size=2", "route.distance_m=2"]
    path.write_text(
        f"first_seed: 3\nrecordings: {{team: {{count: 2, overrides: {lines}}}}}\nestimators:\n"
        "  ekf_slam: {recordings: team, repeats: [1, 1]}\n"
        "  fastslam: {recordings: team, repeats: [2, 2], overrides: [estimator.n_particles=10]}\n"
    )
    suite = read_suite(path)
    rows = run_suite(suite, {"ekf_slam": 1, "fastslam": 2}, n_jobs=1)
    assert set(rows["status"]) == {"ok"}
    assert len(rows) == 6
    particles = rows[rows["estimator"] == "fastslam"]
    assert particles["ate_rmse_m"].nunique() == 4  # each repeat has a stream of its own
    again = run_suite(suite, {"fastslam": 2}, n_jobs=1)
    assert again["ate_rmse_m"].tolist() == particles["ate_rmse_m"].tolist()
    other = run_suite(suite, {"fastslam": 2}, n_jobs=1, reseed=1)
    assert not set(other["ate_rmse_m"]) & set(again["ate_rmse_m"])
    assert other["fingerprint"].tolist() == again["fingerprint"].tolist()
    assert draw_run(suite, "ekf_slam", 3, tmp_path / "run.png")
    assert write_recordings(suite, tmp_path) == 0


def test_each_robot_draws_from_streams_of_its_own(monkeypatch):
    states = []

    def spy(seed, axis, index=0, **named):
        rng = stream(seed, axis, index, **named)
        states.append((axis, str(rng.bit_generator.state)))
        return rng

    monkeypatch.setattr("experiments.runs.objects.stream", spy)
    composed("route.distance_m=1").simulate_team()
    drawn = [state for state in states if state[0] in ("slip", "sensors")]
    assert len(drawn) == len(set(drawn)) == 4


def test_a_calibration_is_each_robots_own_or_all_robots(tmp_path):
    team = composed().recordings()
    teams.save(team, tmp_path / "team.npz")
    files = []
    for number, gain in enumerate((1.02, 0.97)):
        wheels = Wheels(gain_right=gain, gain_left=gain, track_m=0.2, delay_s=0.0)
        slip = Slip(kr=1e-4 * (1 + number), kl=1e-4, forward_slip_m=3e-3)
        found = Calibration(wheels, slip)
        files.append(str(tmp_path / f"{number}.yaml"))
        write_calibration(tmp_path / f"{number}.yaml", found, {})
    read = [f"recording={tmp_path / 'team.npz'}", f"calibration=[{','.join(files)}]"]
    experiment = composed(*read)
    for gain, own, logged in zip((1.02, 0.97), experiment.recordings().robots, team.robots,
                                 strict=True):  # fmt: skip
        np.testing.assert_allclose(own.wheels.position_m, gain * logged.wheels.position_m)
    believed = experiment.config["estimator"]
    assert believed["kr"] == pytest.approx(1.5e-4)
    assert believed["forward_slip_m"] == pytest.approx(3e-3)
    [row] = evaluate(experiment)
    assert row["status"] != Outcome.FAILED
    alike = composed(read[0], f"calibration={files[0]}").recordings().robots
    assert all(robot.robot.track_m == 0.2 for robot in alike)
    with pytest.raises(InputError, match="3 files for a team of 2"):
        composed(read[0], f"calibration=[{files[0]},{files[0]},{files[1]}]").recordings()
