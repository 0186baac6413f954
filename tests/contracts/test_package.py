"""The wheel: built from the sdist, installed elsewhere, and used in a folder of its own."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from experiments.runs.version import code_version

ROOT = Path(__file__).resolve().parents[2]
QUICK = ["simulation.physics=kinematic", "route=linear_1"]
_BUILD = "from setuptools import build_meta; print(build_meta.build_{}({!r}))"

pytestmark = pytest.mark.slow


def tracked(*folders):
    """Files of the clone that git knows or would take."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", *folders]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a clone: git does not list the files to build from")
    return [name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def build(what, source, out):
    """Run setuptools itself, as the isolated build of pip or uv would; return the file's path."""
    pytest.importorskip("setuptools.build_meta", reason="no setuptools to build with")
    done = subprocess.run(
        [sys.executable, "-c", _BUILD.format(what, str(out))],
        cwd=source,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return out / done.stdout.split()[-1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel made from an sdist, which is made from a copy of the clone."""
    folder = tmp_path_factory.mktemp("build")
    for name in tracked():
        copy = folder / "clone" / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, copy)
    sdist = build("sdist", folder / "clone", folder)
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    return build("wheel", folder / sdist.name.removesuffix(".tar.gz"), folder)


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A command `estima` of the wheel, in a folder whose path has a space and an umlaut."""
    folder = tmp_path_factory.mktemp("Füße und Räder")
    try:
        venv.create(folder / "venv", with_pip=True)
    except subprocess.CalledProcessError:
        pytest.skip("this Python cannot make an environment with pip")
    python = folder / "venv" / "bin" / "python"
    install = ["-m", "pip", "install", "--quiet", "--no-index", "--no-deps", str(wheel)]
    subprocess.run([python, *install], check=True, timeout=120, env=clean())
    packages = Path(
        subprocess.check_output(
            [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], text=True
        ).strip()
    )
    # The libraries of this environment; its own .pth files, of an editable install, are not read
    (packages / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")

    def estima(*arguments, cwd=folder):
        """Run the command as a user would; return what it printed."""
        command = [str(folder / "venv" / "bin" / "estima"), *arguments]
        done = subprocess.run(
            command, cwd=cwd, capture_output=True, text=True, timeout=300, env=clean()
        )
        return done.returncode, done.stdout + done.stderr

    where = subprocess.check_output(
        [python, "-c", "import experiments; print(experiments.__file__)"],
        text=True, cwd=folder, env=clean(),
    )  # fmt: skip
    assert Path(where.strip()).is_relative_to(packages), "the wheel is what runs"
    return estima, folder, python


def clean():
    """Environment without what would lead to the clone."""
    return {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "ESTIMA"))}


def test_it_holds_every_file_that_the_code_reads(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    code = tracked("estima", "estimators", "experiments", "sim")
    data = [f"experiments/packaged/{name}" for name in tracked("conf", "results/baselines")]
    assert [name for name in [*code, *data] if name not in names] == []
    others = {name.split("/")[0] for name in names}
    expected = {"estima", "estimators", "experiments", "sim"}
    assert {name for name in others if not name.endswith(".dist-info")} == expected


def test_run_options_and_version(installed):
    estima, folder, _ = installed
    code, said = estima("run", *QUICK, "name=first")
    assert code == 0, said
    assert "position RMSE" in said
    (row,) = (folder / "results" / "runs" / "first").glob("*.journal")
    assert (row.parent / row.name.partition(".")[0] / "run.png").exists()
    assert "odometry" in estima("options")[1]
    assert estima("--version")[1].split() == ["estima", "0.2.0,", "code", code_version()]


def test_results_go_where_the_option_says(installed):
    estima, folder, _ = installed
    for arguments in (("--results", "elsewhere", "run"), ("run", "--results=elsewhere")):
        code, said = estima(*arguments, *QUICK, "name=moved", f"seed={len(arguments)}")
        assert code == 0, said
    assert len(list((folder / "elsewhere" / "runs" / "moved").glob("*.journal"))) == 2
    assert not (folder / "results" / "runs" / "moved").exists()


def test_a_sweep_by_the_command_and_by_the_api(installed):
    estima, folder, python = installed
    code, said = estima("run", "-m", *QUICK, "name=sweep", "seed=range(0,3)")
    assert code == 0, said
    assert len(list((folder / "results" / "runs" / "sweep").glob("*.parquet"))) == 3
    code, said = estima("table", "sweep", "--rows", "-o", "sweep.csv")
    assert code == 0, said
    script = f"import estima; print(len(estima.sweep(*{QUICK}, 'seed=range(0,3)', name='sweep')))"
    done = subprocess.run(
        [python, "-c", script], cwd=folder, env=clean(), capture_output=True, text=True, timeout=120
    )
    assert done.stdout.split() == ["3"], done.stderr
    assert "3 of them done before" in done.stderr


def test_options_of_ones_own_in_such_a_folder(installed):
    estima, folder, _ = installed
    (folder / "eigene" / "robot").mkdir(parents=True)
    option = "defaults: [puzzlebot]\nkr: 3.0e-5\n"
    (folder / "eigene" / "robot" / "own.yaml").write_text(option)
    for many in ([], ["-m"]):
        given = [*many, "--config-dir", "eigene", *QUICK, "robot=own", "name=own", "picture=false"]
        code, said = estima("run", *given)
        assert code == 0, said


def test_the_gate_takes_the_baselines_of_the_wheel_or_of_the_folder(installed, tmp_path):
    estima, _, _ = installed
    code, said = estima("check", "--only", "odometry", cwd=tmp_path)
    assert code == 0, said
    assert "identical" in said
    own = tmp_path / "results" / "baselines"
    code, said = estima("check", "--only", "odometry", "--accept", "mine", cwd=tmp_path)
    assert code == 0, said
    assert {"check.csv", "release.csv"} <= {path.name for path in own.iterdir()}
    assert "site-packages" not in said
    own.joinpath("check.csv").write_text("damaged\n")
    code, said = estima("check", "--only", "odometry", cwd=tmp_path)
    assert code == 2
    assert str(tmp_path / "results" / "baselines" / "check.csv") in said


def test_the_report_needs_results(installed, tmp_path):
    estima, _, _ = installed
    code, said = estima("report", cwd=tmp_path)
    assert code == 2
    assert "estima reproduce" in said
    assert len(said.splitlines()) == 1
    (tmp_path / "results").mkdir()
    shutil.copy(ROOT / "results" / "claims.csv", tmp_path / "results")
    code, said = estima("report", cwd=tmp_path)
    assert code == 0, said
    assert "<style>" in (tmp_path / "results" / "report.html").read_text()
