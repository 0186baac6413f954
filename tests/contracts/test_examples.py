"""docs/examples and docs/notebooks: each runs in an empty folder, and writes only there."""

import ast
import json
import runpy
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "examples"
NOTEBOOKS = sorted((FOLDER.parent / "notebooks").glob("*.ipynb"))
WRITES = {
    "external_odometry": set(),  # tests/estimators/test_programs.py runs it
    "first_run": {"first_run.png"},
    "gate": {"gate.yaml", "gate.baselines", "results"},
    "own_estimator": set(),
    "own_sensor": {"beacon.npz"},
    "own_world": {"own_world.png"},
    "real_log": {"room.log", "trajectory.tum"},
    "sweep_and_plot": {"sweep.png", "results"},
}


@pytest.fixture
def example(tmp_path, monkeypatch, capsys):
    """Run one in an empty folder; return what it printed, what it wrote, and its names."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ESTIMA_RESULTS", raising=False)

    def run(name):
        monkeypatch.setattr(sys, "argv", [f"{name}.py"])
        names = runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out, {path.name for path in tmp_path.iterdir()}, names

    return run


def test_every_script_is_tried_and_short():
    scripts = {path.stem: len(path.read_text().splitlines()) for path in FOLDER.glob("*.py")}
    assert set(scripts) == set(WRITES)
    assert max(scripts.values()) <= 50


def test_first_run(example):
    said, written, names = example("first_run")
    assert written == WRITES["first_run"]
    assert "ok" in said
    assert 0.0 < names["scores"]["ate_rmse_m"] < 2.0
    assert 1.0 < names["scores"]["nees_mean"] < 9.0


def test_own_estimator(example):
    said, written, _ = example("own_estimator")
    assert written == WRITES["own_estimator"]
    own, odometry = said.splitlines()
    assert own.startswith("Simple")
    assert odometry.startswith("odometry")
    assert own.split()[1:3] == odometry.split()[1:3], "the same means, another covariance"


def test_own_sensor(example, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))  # the example extends it
    said, written, names = example("own_sensor")
    assert written == WRITES["own_sensor"]
    assert [line.split()[0] for line in said.splitlines()] == [
        *("laser", "rear", "beacon", "odometry", "ekf_icp", "fused")
    ]
    assert names["row"]["ate_rmse_m"] < 0.03
    assert len((FOLDER / "beacon" / "beacon.py").read_text().splitlines()) < 40


@pytest.mark.slow
def test_own_world(example):
    said, written, names = example("own_world")
    assert written == WRITES["own_world"]
    assert "ok" in said
    assert names["recording"].truth.world.name == "lab"
    assert names["run"].row["ate_rmse_m"] < 0.05


@pytest.mark.slow
def test_sweep_and_plot(example):
    _, written, names = example("sweep_and_plot")
    assert written == WRITES["sweep_and_plot"]
    assert len(names["table"]) == 15
    errors_m = names["table"].groupby("robot.kr")["ate_rmse_m"].mean()
    assert errors_m.is_monotonic_increasing


def test_real_log(example):
    said, written, names = example("real_log")
    assert written == WRITES["real_log"]
    assert "ok" in said
    rows = Path("trajectory.tum").read_text().splitlines()
    rows = [row for row in rows if not row.startswith("#")]
    assert len(rows) == len(names["recording"].frame_stamps)
    assert names["recording"].truth is None


@pytest.mark.slow
def test_gate(example):
    said, written, _ = example("gate")
    assert written == WRITES["gate"]
    verdicts = [line for line in said.splitlines() if line in ("worse", "as good as the baseline")]
    assert verdicts == ["as good as the baseline", "worse"]


def cells_of(path):
    """Source of each code cell."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def run_cells(cells, name):
    """Run cells in one namespace; the value of a last expression is shown, as Jupyter does."""
    names = {}
    for number, source in enumerate(cells, start=1):
        tree = ast.parse(source)
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, f"{name}, cell {number}", "exec"), names)
        if last is not None:
            value = eval(
                compile(ast.Expression(last.value), f"{name}, cell {number}", "eval"), names
            )
            getattr(value, "_repr_html_", lambda value=value: repr(value))()
    return names


def test_there_are_three_without_outputs():
    assert [path.stem for path in NOTEBOOKS] == ["own_estimator", "run", "sweep"]
    for path in NOTEBOOKS:
        assert not any(cell.get("outputs") for cell in json.loads(path.read_text())["cells"])


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_cells_run_in_order(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ESTIMA_RESULTS", raising=False)
    assert "estima" in run_cells(cells_of(path), path.name)


def test_a_cell_that_fails_is_named():
    with pytest.raises(ZeroDivisionError):
        run_cells(["x = 1", "x / 0"], "broken")
    assert run_cells(["x = 1", "x + 1"], "fine")["x"] == 1
