"""What a row depends on is found while it is made; what has changed makes it stale, and only it."""

import shutil
import sys
import time
from importlib import metadata

import pytest

from experiments.runs import store
from experiments.runs.dependencies import digests, recorder, sources
from experiments.runs.dependencies.digests import changed
from experiments.runs.dependencies.recorder import _command_digests, digest_of_all, recorded
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.paths import SOURCE
from experiments.sweeps.work import run_and_record

QUICK = ["simulation.physics=kinematic", "simulation.rays=exact", "route=linear_1"]
FILES = {
    "rows_mine.py": """
import functools, subprocess
import numpy as np
import rows_helper
from rows_package import part
from estimators.odometry import Odometry
from sim.formats.detect import read_any

class Mine(Odometry):
    def __init__(self, table="", tables=()):
        super().__init__(kr=1e-5, kl=1e-5)
        self.words = [read(path) for path in (table, *tables)]
        subprocess.run(["rows-program"], check=True)

@functools.cache
def read(path):
    return open(path).read()

def log(path, config):
    read(path)
    return Experiment({**config, "recording": None}).simulate()

from experiments.runs.experiment import Experiment
""",
    "rows_helper.py": "x = 1\n",
    "rows_package/__init__.py": "",
    "rows_package/part.py": "from . import deeper\n",
    "rows_package/deeper.py": "y = 1\n",
    "rows_sensor.py": """
from sim.sensors.gyroscope import Gyroscope
from sim.options import options

@options("sensors.gyroscope")
class Own(Gyroscope):
    pass
""",
    "one.txt": "1",
    "two.txt": "2",
    "log.csv": "3",
    "rows-program": "#!/bin/sh\ntrue\n",
    "conf/estimator/rows_mine.yaml": "_target_: rows_mine.Mine\n# said\n",
}


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A run of everything of one's own: its experiment, and the folder of its row."""
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    for name in [n for n in sys.modules if n.startswith("rows_")]:
        monkeypatch.delitem(sys.modules, name)
    return compose(tmp_path), tmp_path / "results" / "runs" / "own"


def compose(folder):
    return Experiment.compose(
        [
            *QUICK,
            f"hydra.searchpath=[{folder}/conf]",
            "estimator=rows_mine",
            f"estimator.table={folder}/one.txt",
            f"estimator.tables=[{folder}/two.txt]",
            f"recording={{_target_: rows_mine.log, path: {folder}/log.csv}}",
            "+sensors.own={_target_: rows_sensor.Own}",
        ]
    )


def make_row(experiment, folder):
    """Run it as a job of a sweep does; return whether the row is done."""
    with store.journal(folder / f"rows-{time.time_ns()}.journal") as journal:
        run_and_record(experiment, {}, journal)
    store.compact(journal.path)
    assert is_done(experiment, folder), store.ended(folder)


def is_done(experiment, folder):
    return int(experiment.key, 16) in store.ended(folder).done


CHANGES = {
    "an estimator's module": ("rows_mine.py", "class Mine", "z = 1\nclass Mine"),
    "a helper beside it": ("rows_helper.py", "1", "2"),
    "a package beside it": ("rows_package/deeper.py", "1", "2"),
    "a sensor": ("rows_sensor.py", "pass", "more = 1"),
    "a program on PATH": ("rows-program", "true", "false"),
    "a file under any key": ("one.txt", "1", "2"),
    "a file in a list": ("two.txt", "2", "3"),
    "a log": ("log.csv", "3", "4"),
}


def test_a_row_is_stale_once_anything_of_ones_own_has_changed(own):
    experiment, folder = own
    make_row(experiment, folder)
    place = folder.parents[2]
    for kind, (name, before, after) in CHANGES.items():
        text = (place / name).read_text()
        (place / name).write_text(text.replace(before, after))
        assert not is_done(experiment, folder), kind
        (place / name).write_text(text)
        assert is_done(experiment, folder), kind
    for name, text in FILES.items():
        if name.endswith((".py", ".yaml")):
            (place / name).write_text(f"# a comment\n{text}\n")
    (place / "rows_beside.py").write_text("unrelated = True\n")
    assert is_done(experiment, folder), "comments, and files that are not used"
    text = FILES["conf/estimator/rows_mine.yaml"]
    (place / "conf/estimator/rows_mine.yaml").write_text(f"{text}tables: [one.txt]\n")
    again = Experiment.compose([*QUICK, f"hydra.searchpath=[{place}/conf]", "estimator=rows_mine"])
    assert again.key != experiment.key, "a configuration"
    assert not is_done(again, folder)


def test_a_second_run_of_the_same_process_depends_on_the_same(own):
    experiment, folder = own
    make_row(experiment, folder)
    make_row(experiment.with_values(seed=1), folder)  # what is cached or imported is not seen again
    assert len(list((folder / "dependencies").iterdir())) == 1
    (folder.parents[2] / "two.txt").write_text("other")
    assert not is_done(experiment, folder)
    assert not is_done(experiment.with_values(seed=1), folder)


def seen_by(*overrides):
    experiment = Experiment.compose([*QUICK, *overrides])
    team = experiment.recordings
    with recorded(evaluate.__module__) as found:
        evaluate(experiment, team)
    return found.digests()


def test_code_counts_where_it_is_used(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    laser = ["sensors=hokuyo", "sensors.laser.n_beams=11", "sensors.laser.rate_hz=5.0"]
    odometry = seen_by("estimator=odometry", *laser)
    icp = seen_by("estimator=icp_odometry", *laser)  # its recording comes from the cache
    again = seen_by("estimator=odometry", *laser)
    assert again == odometry, "whatever else was loaded meanwhile"
    added = set(icp) - set(odometry)
    assert "estimators/laser/icp_odometry.py" in added
    assert all(name.startswith(("estimators/", "package ")) for name in added)
    assert {"sim/simulate.py", "sim/robot/slip.py", "package numpy"} <= set(icp)
    assert "sim/robot/bullet.py" not in icp
    for name in ("experiments/cli/main.py", "sim/formats/carmen.py"):
        assert name not in icp


def test_a_change_of_the_house_is_seen(tmp_path, monkeypatch):
    """In a copy: of the simulator, an estimator, evaluation and a library's version."""
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path / "results"))
    found = seen_by("estimator=odometry")
    for name in ("sim", "estimators", "experiments"):
        shutil.copytree(
            SOURCE / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    monkeypatch.setattr(digests, "SOURCE", tmp_path)
    assert changed(found) == []
    for name in ("sim/robot/slip.py", "estimators/odometry.py", "experiments/evaluation/metrics.py",
                 "experiments/evaluation/map_quality.py", "estimators/team.py",
                 "experiments/runs/calibration.py", "sim/formats/assemble.py"):  # fmt: skip
        path = tmp_path / name
        text = path.read_text()
        path.write_text(text.replace("\n\n\n", "\n\n\n# a comment\n", 1).replace('"""', '"""A ', 1))
        assert changed(found) == [], "a comment and a docstring"
        path.write_text(f"{text}\nadded = 1\n")
        assert changed(found) == [name]
        path.write_text(text)
    kept = digests.package_version
    monkeypatch.setattr(digests, "package_version", lambda n: "0.0" if n == "scipy" else kept(n))
    assert "package scipy" in changed(found)


def test_a_cached_recording_is_made_again_when_a_file_behind_it_has_changed(own, monkeypatch):
    _, folder = own
    monkeypatch.setenv("ESTIMA_RESULTS", str(folder.parents[1]))
    experiment = Experiment.compose([*QUICK, "+sensors.own={_target_: rows_sensor.Own}"])
    made = []
    monkeypatch.setattr(
        Experiment,
        "simulate_team",
        lambda self, *_: made.append(1) or super(Experiment, self).simulate_team(),
    )
    for n_made in (1, 1):
        experiment.recording()
        assert len(made) == n_made
    (folder.parents[2] / "rows_sensor.py").write_text(FILES["rows_sensor.py"] + "\nz = 1\n")
    experiment.recording()
    assert len(made) == 2


def test_recording_costs_little():
    """Two parts in a hundred of the cheapest run of a sweep, 20 ms, are 400 us."""
    seen_by("estimator=odometry")
    begun = time.process_time()
    for _ in range(100):
        with recorded(evaluate.__module__, "estimators.odometry") as found:
            pass
        digest_of_all(found.digests())
    assert (time.process_time() - begun) / 100 < 2e-3  # with room for a busy machine


def test_code_of_an_isolated_estimator_counts_though_it_is_not_loaded(own):
    experiment, folder = own
    for name in [name for name in sys.modules if name.startswith("rows_")]:
        del sys.modules[name]
    with recorded() as found:
        experiment.with_values(isolated=True).estimator()
    place = folder.parents[2]
    names = {str(place / name) for name in FILES if name.endswith((".py", ".txt"))}
    assert names - set(found.digests()) == {str(place / "rows_sensor.py")}
    assert "rows_mine" not in sys.modules
    assert "estimators/odometry.py" in found.digests()


def test_what_a_source_says():
    said = sources.read_source(b'"""Doc."""\nx = 1  # one\ndef f():\n    "does"\n    return x\n')
    same = sources.read_source(b'x = 1\n\n\n\ndef f():\n    """Does it."""\n    return (x)\n')
    assert said == same
    assert sources.read_source(b"x = 2\ndef f():\n    return x\n").digest != said.digest
    assert sources.read_source(b"def broken(").imports == ()
    text = b"import a.b\nfrom . import c\nfrom ..d import e\ntry:\n    import f\nexcept E:\n"
    text += b"    import g\n"
    assert set(sources.read_source(text).imports) == {"a.b", ".", ".c", "..d", "..d.e", "f", "g"}
    lazy = b"if TYPE_CHECKING:\n    import a\ndef f():\n    import b\n"
    assert sources.read_source(lazy).imports == ()


def test_what_was_damaged_is_not_believed(tmp_path):
    digest = store.keep_dependencies({"sim/se2.py": "0"}, tmp_path)
    assert store.stale_because(digest, tmp_path) == ["sim/se2.py"]
    path = tmp_path / "dependencies" / f"{digest}.json"
    for text in ("{}", "[", '{"sim/se2.py": "1"}', "[1]", "{" * 5000):
        path.write_text(text)
        assert store.stale_because(digest, tmp_path) is None
    assert recorder.digest_of_all({}) != digest
    assert store.stale_because("../../x", tmp_path) is None
    assert digests.package_version("rows_never_imported") is None
    assert digests.present_digest("/dev/zero") is None
    assert digests.present_digest("package ../x") is None


def test_the_interpreter_of_a_command_is_not_a_file_it_depends_on(tmp_path):
    script = tmp_path / "method.py"
    script.write_text("")
    assert list(_command_digests(sys.executable, (str(script),), None)) == [str(script)]


def test_a_package_has_the_version_of_its_distribution():
    """As the standard library finds it, which takes longer."""
    by_module = metadata.packages_distributions()
    for module in ("hydra", "yaml", "PIL", "dateutil", "antlr4", "six", "numpy"):
        assert digests.package_version(module) == metadata.version(by_module[module][0])
    assert digests.package_version("no_such_module") is None
