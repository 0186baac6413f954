"""Who may import whom, and what every module must keep to."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MODULES = sorted(p for d in ("sim", "estimators", "experiments") for p in (ROOT / d).rglob("*.py"))
NAMES = [str(p.relative_to(ROOT)) for p in MODULES]


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_layers(path):
    folder = path.relative_to(ROOT).parts[0]
    forbidden = {"sim": ("estimators", "experiments"), "estimators": ("experiments",)}
    for name in imports(path):
        top = name.split(".")[0]
        assert top not in forbidden.get(folder, ()), f"{path.name} imports {name}"
        assert top != "pickle"
        if top == "pybullet":
            assert path.name == "bullet.py"
    if folder == "estimators":
        for name in imports(path):
            assert not name.startswith(("sim.bullet", "sim.simulate")), (
                "an estimator sees Frames only"
            )


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_no_global_randomness_and_no_eval(path):
    text = path.read_text()
    assert not re.search(r"np\.random\.(seed|rand|randn|normal|uniform|choice)\(", text)
    assert not re.search(r"(?<![\w.])(eval|exec)\(", text)
    assert "allow_pickle=True" not in text


METHODS = {
    "odometry",
    "icp_odometry",
    "ekf_icp",
    "ekf_icp_paper",
    "fastslam",
    "ekf_slam",
    "mcl",
    "topological_mcl",
    "smoother",
}


def test_no_method_imports_another():
    for path in (ROOT / "estimators").glob("*.py"):
        if path.stem in METHODS:
            for name in imports(path):
                parts = name.split(".")
                other = parts[1] if parts[0] == "estimators" and len(parts) > 1 else None
                assert other not in METHODS - {path.stem}, f"{path.name} imports {name}"


def test_no_addresses_or_machine_paths_in_tracked_text():
    lock = (ROOT / "requirements.lock").read_text()
    assert "://" not in lock
    assert "--index" not in lock
