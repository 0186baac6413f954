"""What data may name: classes of conf/, and never commands; docs/security.md."""

import json
import shlex
import sys
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments.cli.main import _own_first, app
from experiments.gate.suite import read_suite, run_suite
from experiments.runs.compose import open_composer
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.paths import CONF, results
from experiments.runs.store import write_table
from experiments.sweeps.again import noted_config_dir, run_of_row
from experiments.sweeps.plan import make_plan
from sim.errors import InputError
from tests.experiments.cli.test_cli import QUICK, called, refused

DRIVE = [*QUICK, "route=linear_1", "name=foreign"]
REFUSED = r"names code to run, .*; if you trust where it comes from, add --trust"


@pytest.fixture
def marker(tmp_path, monkeypatch):
    """A file that hostile code touches; and a module `hostile`, which does so when imported."""
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path / "results"))
    monkeypatch.delitem(sys.modules, "hostile", raising=False)
    touched = tmp_path / "touched"
    (tmp_path / "hostile.py").write_text(
        f"open({str(touched)!r}, 'w')\nfrom estimators.odometry import Odometry as Mine\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield touched
    sys.modules.pop("hostile", None)


@pytest.fixture(scope="module")
def sound_row(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ESTIMA_RESULTS", str(tmp_path_factory.mktemp("results")))
        (row,) = evaluate(Experiment.compose(DRIVE))
    return row


def touching(marker):
    return json.dumps([sys.executable, "-c", f"open({str(marker)!r}, 'w')"])


def hostile_rows(marker):
    command = touching(marker)
    external = {"estimator._target_": "estimators.programs.external.External"}
    return {
        "command": {"choice.estimator": "external", **external, "estimator.command": command},
        "command as a line": {
            "choice.estimator": "external",
            **external,
            "estimator.command": f"touch {marker}",
        },
        "class": {"estimator._target_": "hostile.Mine"},
        "function of the package": {
            "world._target_": "sim.files.write_text",
            "world.path": str(marker),
            "world.text": "x",
        },
        "recording": {"recording._target_": "os.system", "recording.command": f"touch {marker}"},
        "map": {"prior.map._target_": "os.system", "prior.map.command": f"touch {marker}"},
        "sensor": {"sensors.encoder._target_": "hostile.Mine"},
        "feedback": {
            "route.feedback._target_": "estimators.programs.external.External",
            "route.feedback.command": command,
        },
        "option elsewhere": {"choice.estimator": "../../hostile"},
        "hydra": {"choice.hydra.searchpath": "[pkg://hostile]", "choice.+hydra/launcher": "basic"},
    }


@pytest.mark.parametrize("name", hostile_rows(""))
def test_a_row_runs_nothing_that_it_names(marker, sound_row, name):
    row = pd.Series({**sound_row, **hostile_rows(marker)[name]})
    with pytest.raises(InputError, match=rf"{REFUSED}|no option|the run had choice\."):
        run_of_row(row)
    assert not marker.exists()


def test_view_and_report_run_nothing_that_results_name(marker, sound_row, tmp_path):
    import pyarrow as pa

    row = {**sound_row, **hostile_rows(marker)["command"]}
    folder = results() / "runs" / "foreign"
    folder.mkdir(parents=True)
    write_table(pa.Table.from_pylist([row]), folder / "rows")
    key = row["run_key"][:10]
    refused(called("view", f"foreign/{key}", "-o", str(tmp_path / "a.html")), "--trust")
    said = CliRunner().invoke(
        app, ["report", "foreign", "--all-versions", "--pictures", "-o", str(tmp_path / "a.html")]
    )
    assert said.exit_code == 0, said.output
    assert "add --trust" in said.stderr
    assert not marker.exists()


def test_a_noted_folder_of_options_runs_nothing(marker, sound_row, tmp_path):
    own = tmp_path / "own"
    (own / "estimator").mkdir(parents=True)
    (own / "estimator" / "odometry_2.yaml").write_text("_target_: hostile.Mine\n")
    (tmp_path / "command.txt").write_text(f"estima run -m --config-dir {shlex.quote(str(own))} x\n")
    noted = noted_config_dir(tmp_path)
    assert noted == str(own)
    row = pd.Series({**sound_row, "choice.estimator": "odometry_2"})
    with pytest.raises(InputError, match=REFUSED):
        run_of_row(row, None, noted)
    assert not marker.exists()
    row["estimator._target_"] = "hostile.Mine"
    run_of_row(row, own)  # it is the user who names the folder
    assert marker.exists()


STUDIES = {
    "recording": "recording: {_target_: os.system, command: touch MARKER}\n",
    "estimator": "estimator: {_target_: hostile.Mine}\n",
    "followed": "word: hostile.Mine\nestimator: {_target_: '${word}'}\n",
    "with a missing value": "word: ???\nestimator: {_target_: hostile.Mine, kr: '${word}'}\n",
    "command": "defaults: [{override /estimator: external}]\nestimator: {command: touch MARKER}\n",
    "command of conf": "defaults: [{override /estimator: peers/mrpt_icp}]\n",
    "team": "team: {robots: [{robot: {_target_: hostile.Mine}}]}\n",
    "sweeps": "sweeps: [{estimator._target_: 'hostile.Mine'}]\n",
    "swept map": "sweeps: [{prior.map: '{_target_: os.system, command: x},none'}]\n",
    "swept feedback": "sweeps: [{route.feedback: 'truth,{_target_: hostile.Mine}'}]\n",
    "swept commands": "defaults: [{override /estimator: external}]\n"
    "sweeps: [{estimator.command: 'touch MARKER,touch MARKER2'}]\n",
    "swept folders": "sweeps: [{hydra.searchpath: '[pkg://hostile]'}]\n",
    "added folders": "sweeps: [{+hydra.searchpath: '[pkg://hostile]'}]\n",
    "folders": "hydra: {searchpath: ['pkg://hostile']}\n",
    "params": "hydra: {sweeper: {params: {estimator._target_: hostile.Mine}}}\n",
}


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_from_elsewhere_runs_nothing(marker, tmp_path, monkeypatch, name):
    path = tmp_path / "theirs.yaml"
    path.write_text("# @package _global_\n" + STUDIES[name].replace("MARKER", str(marker)))
    with pytest.raises(InputError, match=rf"theirs\.yaml {REFUSED}|searchpath"):
        make_plan([f"study={path}"])
    assert not marker.exists()
    if name == "estimator":
        for value in ("", "0", "no", "false", "yes"):
            monkeypatch.setenv("ESTIMA_TRUST", value)
            with pytest.raises(InputError, match=REFUSED):
                Experiment.compose([f"study={path}"])
        assert not marker.exists()
        monkeypatch.setenv("ESTIMA_TRUST", "1")
        assert type(Experiment.compose([f"study={path}"]).estimator()).__name__ == "Odometry"
        assert marker.exists()


def test_what_the_user_names_runs_with_a_study_from_elsewhere(marker, tmp_path):
    study = tmp_path / "theirs.yaml"
    study.write_text("# @package _global_\ndefaults: [{override /route: linear_1}]\nseed: 7\n")
    (tmp_path / "own" / "estimator").mkdir(parents=True)
    (tmp_path / "own" / "estimator" / "mine.yaml").write_text("_target_: hostile.Mine\n")
    searched = f"hydra.searchpath=[file://{tmp_path}/own]"
    for words in (
        [searched, "estimator=mine"],
        ["estimator=external", f"estimator.command={touching(marker)}"],
        ["estimator._target_=hostile.Mine"],
    ):
        experiment = Experiment.compose([*words, f"study={study}"])
        assert experiment.seed == 7
        experiment.check_estimator()
    swept = make_plan([searched, "estimator=mine,odometry", f"study={study}"])
    assert {f.first.choices["estimator"] for f in swept.families} == {"mine", "odometry"}


def test_a_study_of_conf_may_be_named_by_its_file():
    path = CONF / "study" / "real_logs" / "intel.yaml"
    with open_composer([f"study={path}"]) as composer:
        assert composer.words == ["study=real_logs/intel"]


@pytest.mark.parametrize(
    "override",
    [
        "estimator._target_=hostile.Mine",
        "prior.map={_target_: hostile.Mine}",
        "hydra.searchpath=[pkg://hostile]",
        "+hydra.searchpath=[pkg://hostile]",
        "++hydra.searchpath=[pkg://hostile]",
        "study=theirs.yaml",
    ],
)
def test_a_suite_from_elsewhere_runs_nothing(marker, tmp_path, monkeypatch, override):
    monkeypatch.chdir(tmp_path)
    Path("theirs.yaml").write_text(f"# @package _global_\n{STUDIES['estimator']}")
    Path("suite.yaml").write_text(
        json.dumps(
            {
                "first_seed": 0,
                "recordings": {"a": {"count": 2, "overrides": [*DRIVE, override]}},
                "estimators": {"odometry": {"recordings": "a", "repeats": [1, 1]}},
            }
        )
    )
    with pytest.raises(InputError, match=rf"{REFUSED}|is not a folder|cannot be set by"):
        run_suite(read_suite(Path("suite.yaml")), {"odometry": 1}, n_jobs=1)
    assert not marker.exists()


def test_the_flag_may_be_anywhere():
    assert _own_first(["view", "a/b", "--trust"]) == ["--trust", "view", "a/b"]
    assert _own_first(["run", "--results", "r", "--trust"])[:1] == ["--trust"]


def test_hydras_pickles_are_not_read(tmp_path):
    for words in (["run"], ["run", "-m", "seed=0,1"], ["record", "-o", "a.npz"]):
        done = called(*words, f"--experimental-rerun={tmp_path / 'x.pickle'}")
        assert done.returncode == 2
        assert "Traceback" not in done.stderr
