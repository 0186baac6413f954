"""A run of a sweep made again from its row, to watch it."""

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments.cli.main import app
from experiments.runs import store
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.paths import CONF
from experiments.runs.store import write_run
from experiments.sweeps.again import row_of, run_of_row, short_key
from experiments.viewing.estimates import with_estimates_by
from experiments.viewing.playback import Playback
from sim.errors import InputError

DRIVE = ["simulation.physics=kinematic", "route.distance_m=2", "sensors=laser_stereo", "name=mine"]
RUNS = (
    ["estimator=odometry", "seed=3"],
    ["estimator=fastslam", "estimator.n_particles=10", "seed=4", "repeats=2"],
)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ESTIMA_RESULTS", str(folder))
        for run in RUNS:
            experiment = Experiment.compose([*DRIVE, *run])
            write_run(evaluate(experiment), experiment.rows_folder)
        yield folder


def test_a_run_is_called_by_its_key_and_repeat(results):
    experiment = Experiment.compose([*DRIVE, *RUNS[1]])
    row = row_of(f"mine/{experiment.key[:10]}.1")
    assert short_key(row) == f"{experiment.key[:10]}.1"
    assert row_of("other/123") is None
    with pytest.raises(InputError, match="no such run"):
        row_of("mine/zz")


def test_it_is_the_same_run_whose_picture_is_drawn(results):
    """Columns that another estimator has not got hold floats; the keys agree even so."""
    experiment = Experiment.compose([*DRIVE, *RUNS[1]])
    row = row_of(f"mine/{experiment.key}.1")
    assert isinstance(row["estimator.n_particles"], float)
    again = run_of_row(row)
    assert again.experiment.key == experiment.key
    recording = again.recordings().only
    shown = Playback.of(again.recordings(), 5)
    shown = with_estimates_by(shown, again.experiment, again.repeat, lambda _: None)
    made = shown.robots[0].estimate
    errors = made.means[:, :2] - recording.truth_at(made.stamps)[:, :2]
    assert np.sqrt((errors**2).sum(axis=1).mean()) == pytest.approx(row["ate_rmse_m"], rel=1e-9)


def test_another_run_than_the_rows_is_refused(results, monkeypatch):
    row = row_of(f"mine/{Experiment.compose([*DRIVE, *RUNS[0]]).key}")
    with monkeypatch.context() as patched:
        patched.setattr(store, "code_version", lambda: "other")
        with pytest.raises(InputError, match="another version of the code"):
            row_of(f"mine/{row['run_key']}")
    gone = row.copy()
    gone["choice.estimator"] = "nosuch"
    with pytest.raises(InputError, match=r"^estimator/nosuch is not an option.*own\)"):
        run_of_row(gone, noted="own")
    absent = pd.concat([row, pd.Series({"estimator._target_": "nowhere.Mine"})])
    absent = absent[~absent.index.duplicated(keep="last")]
    monkeypatch.setenv("ESTIMA_TRUST", "1")
    with pytest.raises(InputError, match=r"no module nowhere in .* PYTHONPATH"):
        run_of_row(absent)
    changed = row.copy()
    changed["recording_checksum"] = "other"
    with pytest.raises(InputError, match="recording has changed"):
        run_of_row(changed).recordings()


def test_own_options_are_found_where_the_sweep_found_them(results, tmp_path):
    row = row_of(f"mine/{Experiment.compose([*DRIVE, *RUNS[0]]).key}").copy()
    row["choice.estimator"] = "my_odometry"
    (tmp_path / "estimator").mkdir()
    option = CONF / "estimator" / "odometry.yaml"
    (tmp_path / "estimator" / "my_odometry.yaml").write_text(option.read_text())
    for given in ({"noted": str(tmp_path)}, {"config_dir": tmp_path, "noted": "gone"}):
        assert run_of_row(row, **given).experiment.estimator_name == "my_odometry"


def test_view_and_report_draw_runs_of_a_sweep(results, tmp_path):
    key = Experiment.compose([*DRIVE, *RUNS[0]]).key[:10]
    out = tmp_path / "run.html"
    said = CliRunner().invoke(app, ["view", f"mine/{key}", "-o", str(out), "--seconds", "0.3"])
    assert said.exit_code == 0, said.output
    assert out.stat().st_size > 10_000
    refused = CliRunner().invoke(app, ["view", f"mine/{key}", "-e", "mcl", "-o", str(out)])
    assert isinstance(refused.exception, InputError)

    page = tmp_path / "page.html"
    drawn = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "experiments.report.of_sweep.draw_recorded_run",
            lambda row, how, *_: drawn.append(how.out) or "",
        )
        CliRunner().invoke(app, ["report", "mine", "--pictures", "-o", str(page)])
    assert {path.parent for path in drawn} == {tmp_path / "page" / "pictures"}
    assert f"{key}.html" in {path.name for path in drawn}
    assert len(drawn) == 3  # of one estimator a single run, of the other two repeats
    assert f"estima view mine/{key} -o run.html" in page.read_text()
