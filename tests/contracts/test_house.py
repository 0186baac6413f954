"""The size of files, folders and signatures, and that a default, a print and a flag stand once."""

import ast
import inspect
import re
from collections import Counter
from dataclasses import is_dataclass
from pathlib import Path

import pytest
import yaml

from sim.options import find

ROOT = Path(__file__).resolve().parents[2]
CODE = ("sim", "estimators", "experiments", "estima", "tools")
HOUSE = (*CODE, "tests", "conf", "docs")
MODULES = [path for folder in CODE for path in sorted((ROOT / folder).rglob("*.py"))]
MAX_ARGUMENTS, MAX_LINES, MAX_FILES = 8, 500, 20

# What is still to be mended. Nothing is added here; what is mended leaves.
LONG_SIGNATURES: set[str] = set()
LONG_FILES: set[str] = set()
FULL_FOLDERS: set[str] = set()


def name_of(path):
    return str(path.relative_to(ROOT))


def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def long_signatures(tree, module):
    """Functions with too many arguments; the fields of an option class are none."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            signature = node.args
            arguments = [*signature.posonlyargs, *signature.args, *signature.kwonlyargs]
            counted = [one for one in arguments if one.arg not in ("self", "cls")]
            if len(counted) > MAX_ARGUMENTS:
                yield f"{module}.{node.name}"


def test_no_long_signatures():
    called = {path: path.parent.name if path.stem == "__init__" else path.stem for path in MODULES}
    long = {name for path in MODULES for name in long_signatures(parsed(path), called[path])}
    assert long == LONG_SIGNATURES
    planted = "class A:\n    a: int = 1\n    def f(self, a, b, c, /, d, e, f, *, g, h{}): ..."
    assert not list(long_signatures(ast.parse(planted.format("")), "m"))
    assert list(long_signatures(ast.parse(planted.format(", i")), "m")) == ["m.f"]


def too_long(paths):
    return [path for path in paths if len(path.read_text("utf-8").splitlines()) > MAX_LINES]


def test_no_long_files(tmp_path):
    assert {name_of(path) for path in too_long([*MODULES, *(ROOT / "tests").rglob("*.py")])} == (
        LONG_FILES
    )
    files = [tmp_path / "500.py", tmp_path / "501.py"]
    for path in files:
        path.write_text("\n" * int(path.stem))
    assert too_long(files) == files[1:]


def full_folders(top):
    """Folders that hold too many files, pictures of the documentation aside."""
    files = [path for path in top.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    counts = Counter(path.parent for path in files if path.parent != ROOT / "docs" / "figures")
    return [folder for folder, count in counts.items() if count > MAX_FILES]


def test_no_full_folders(tmp_path):
    assert {name_of(full) for folder in HOUSE for full in full_folders(ROOT / folder)} == (
        FULL_FOLDERS
    )
    (tmp_path / "inside").mkdir()
    for number in range(MAX_FILES + 1):
        assert not full_folders(tmp_path)
        (tmp_path / "inside" / f"{number}.py").touch()
    assert full_folders(tmp_path) == [tmp_path / "inside"]


def team_cases(tree):
    """Lines where a recording of one robot and a team are distinguished by type."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance":
            kinds = ast.walk(node.args[1])
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr):
            kinds = [node.left, node.right] if "Recording" in ast.unparse(node) else []
        else:
            continue
        if any(isinstance(kind, ast.Name | ast.Attribute) and
               ast.unparse(kind).split(".")[-1] == "Team" for kind in kinds):  # fmt: skip
            yield node.lineno


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_robot_is_a_team_of_one(path):
    assert not list(team_cases(parsed(path)))


def test_a_case_for_teams_is_seen():
    for planted in ("isinstance(x, Team)", "isinstance(x, (A, team.Team))", "Recording | Team",
                    "def f(x: 'Team' = 0) -> Team | Recording: ..."):  # fmt: skip
        assert list(team_cases(ast.parse(planted))) == [1], planted
    assert not list(team_cases(ast.parse("isinstance(x, Teams); Team | None")))


# Defaults


def stated(path):
    """Keys of an option, and those of the options that it extends."""
    own = yaml.safe_load(path.read_text()) or {}
    group = ROOT.joinpath(*path.relative_to(ROOT).parts[:2])
    bases = [name for name in own.pop("defaults", []) if name != "_self_"]
    inherited = [part for name in bases for part in reversed(stated(group / f"{name}.yaml"))]
    return own, {key: value for part in inherited for key, value in part.items()}


def restated(own, inherited, place):
    """Keys that state the default of the class which they configure."""
    target = {**inherited, **own}.get("_target_")
    if target is not None:
        yield from defaults_of(find(target, place), own, inherited, place)
    else:
        for name in own:  # the sensors, by their names
            yield from restated(own[name], inherited.get(name) or {}, f"{place}.{name}")


def defaults_of(cls, own, inherited, place):
    for option in inspect.signature(cls).parameters.values() if is_dataclass(cls) else ():
        name, default = option.name, option.default
        if name in own and name not in inherited:
            if is_dataclass(default):
                yield from defaults_of(type(default), own[name], {}, f"{place}.{name}")
            elif own[name] == default:
                yield f"{place}.{name}"


OPTIONS = [
    path
    for group in ("estimator", "robot", "sensors")
    for path in sorted((ROOT / "conf" / group).rglob("*.yaml"))
]


@pytest.mark.parametrize("path", OPTIONS, ids=name_of)
def test_a_default_stands_in_the_class_alone(path):
    assert not list(restated(*stated(path), path.stem))


def test_a_default_that_is_stated_again_is_seen():
    target = {"_target_": "sim.sensors.laser.Laser"}
    beams = inspect.signature(find(target["_target_"], "x")).parameters["n_beams"].default
    assert list(restated({**target, "n_beams": beams}, {}, "laser")) == ["laser.n_beams"]
    assert list(restated({"a": {**target, "n_beams": beams}}, {}, "x")) == ["x.a.n_beams"]
    assert list(restated({**target, "mount": {"y_m": 0.0, "z_m": 0.5}}, {}, "x")) == ["x.mount.y_m"]
    assert not list(restated({**target, "n_beams": beams + 1}, {}, "laser"))
    assert not list(restated({"n_beams": beams}, {**target, "n_beams": beams + 1}, "laser"))


# The command line


FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


def speaks(tree):
    """What a module prints, and the flags that its texts name, docstrings aside."""
    documents = {
        id(node.value) for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }  # fmt: skip
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "print":
            yield "print"
        elif isinstance(node, ast.Constant) and id(node) not in documents:
            yield from FLAG.findall(node.value) if isinstance(node.value, str) else ()


# Modules below cli that print or name flags: the console itself, a script of its own (power), a
# bench of the command line, and those that show commands. Nothing is added; what is mended leaves.
SPEAKING = {
    "bench/sweep.py", "gate/power.py", "gate/report.py", "judging/results.py",
    "report/contents.py", "runs/console.py", "sweeps/commands.py",
}  # fmt: skip


def test_only_the_command_line_prints_and_names_flags():
    below = [path for path in MODULES if path.is_relative_to(ROOT / "experiments")]
    speaking = {str(path.relative_to(ROOT / "experiments")) for path in below
                if "cli" not in path.parts and any(speaks(parsed(path)))}  # fmt: skip
    assert sorted(speaking - SPEAKING) == []
    assert sorted(SPEAKING - speaking) == [], "mended: take them off the list"


def test_a_print_and_a_flag_are_seen():
    planted = '"""Docs of --this."""\nprint(f"set {x} by --that, not a--b or ---")'
    assert sorted(speaks(ast.parse(planted))) == ["--that", "print"]
