"""The notebooks of the documentation: their cells run in order, without Jupyter."""

import ast
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


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
            value = eval(compile(ast.Expression(last.value), f"{name}, cell {number}", "eval"), names)
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
