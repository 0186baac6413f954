"""Who may import whom, and what every module must keep to."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
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
            assert not name.startswith(("sim.robot.bullet", "sim.simulate")), (
                "an estimator sees Frames only"
            )


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_no_global_randomness_and_no_eval(path):
    text = path.read_text()
    assert not re.search(r"np\.random\.(seed|rand|randn|normal|uniform|choice)\(", text)
    assert not re.search(r"(?<![\w.])(eval|exec)\(", text)
    assert "allow_pickle=True" not in text


# The rooms of experiments/, from the top down; each imports only itself and rooms below it.
ROOMS = (
    "cli",
    "reproduce",
    "audit",
    "papers",
    "studies",
    "gate",
    "bench",
    "solve",
    "report",
    "judging",
    "sweeps",
    "twin",
    "calibration",
    "viewing",
    "runs",
    "trajectories",
    "evaluation",
)


def room_of(path):
    return path.relative_to(ROOT / "experiments").parts[0].removesuffix(".py")


def upward(path, lines):
    """Imports of a file in experiments/ that name a room above its own, or none."""
    room = ROOMS.index(room_of(path))
    for name in lines:
        parts = name.split(".")
        inside = parts[0] == "experiments" and len(parts) > 1 and parts[1] in ROOMS
        if parts[0] == "estima" or (inside and ROOMS.index(parts[1]) < room):
            yield name


@pytest.mark.parametrize("path", sorted((ROOT / "experiments").rglob("*.py")), ids=str)
def test_imports_go_down(path):
    if path.name != "__init__.py" or path.parent.name != "experiments":
        assert room_of(path) in ROOMS, "a room without a place in the order"
        assert not list(upward(path, imports(path)))


def test_an_arrow_upward_is_seen():
    path = ROOT / "experiments" / "runs" / "evaluate.py"
    assert list(upward(path, ["experiments.sweeps.collect"]))
    assert not list(upward(path, ["experiments.evaluation.metrics", "estimators.base"]))


def test_no_circle():
    """Modules of all folders, by the imports at their top and inside functions."""
    modules = {
        ".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p
        for p in MODULES
    }
    edges = {n: {m for m in imports(p) if m in modules and m != n} for n, p in modules.items()}
    done, open_ = set(), []

    def visit(name):
        assert name not in open_, " -> ".join([*open_[open_.index(name) :], name])
        if name not in done:
            open_.append(name)
            for other in sorted(edges[name]):
                visit(other)
            done.add(open_.pop())

    for name in sorted(edges):
        visit(name)


def is_method(path):
    """Whether a module holds an estimator: a class with `reset` and `step`, or those of a team."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ClassDef) and "Protocol" not in {
            ast.unparse(b) for b in node.bases
        }:
            defined = {item.name for item in node.body if isinstance(item, ast.FunctionDef)}
            if {"reset", "step"} <= defined or {"reset_team", "step_team"} <= defined:
                return True
    return False


METHODS = {
    ".".join(p.relative_to(ROOT).with_suffix("").parts): p
    for p in (ROOT / "estimators").rglob("*.py")
    if is_method(p)
}


def test_no_method_imports_another():
    assert {
        "estimators.on_a_map.mcl",
        "estimators.graph.smoother",
        "estimators.peers.kiss_icp",
    } <= set(METHODS)
    carrier = "estimators.programs.external"  # to a method in a process of its own
    for method, path in METHODS.items():
        others = set(METHODS) - {method, carrier}
        for name in imports(path):
            assert name not in others, f"{method} imports {name}"


def test_no_addresses_or_machine_paths_in_tracked_text():
    lock = (ROOT / "requirements.lock").read_text()
    assert "://" not in lock
    assert "--index" not in lock
