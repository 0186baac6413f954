"""Command lines that Hydra itself would not understand, ignore, or end with a trace."""

import pytest

from experiments.cli.arguments import CommandLine
from experiments.runs import cache, processes
from experiments.runs.compose import check_overrides, searched
from experiments.runs.console import exit_with
from experiments.runs.experiment import Experiment
from sim.errors import InputError


@pytest.mark.parametrize("options", [{"e": "[e]"}, {"e": "[f]", "f": "[e]"}])
def test_an_option_that_includes_itself_is_one_line(tmp_path, capsys, options):
    (tmp_path / "estimator").mkdir()
    for name, defaults in options.items():
        (tmp_path / "estimator" / f"{name}.yaml").write_text(f"defaults: {defaults}\n")
    with pytest.raises(RecursionError) as raised:
        Experiment.compose([*searched(tmp_path), "estimator=e"])
    with pytest.raises(SystemExit, match="2"):
        exit_with(raised.value)
    assert capsys.readouterr().err.count("\n") == 1


def test_another_endless_recursion_is_an_internal_error(capsys):
    def descend():
        descend()

    with pytest.raises(RecursionError) as raised:
        descend()
    with pytest.raises(SystemExit, match="3"):
        exit_with(raised.value)
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["seed=1", "--config-dir", "a=b", "estimator=x"], (["seed=1", "estimator=x"], "a=b")),
        (["~route", "--resolve", "seed=1", "--cfg", "job", "a=2"], (["~route", "seed=1", "a=2"],)),
        (["--config-dir=a", "seed=1"], (["seed=1"], "a")),
    ],
)
def test_overrides_may_stand_before_and_after_options(arguments, line):
    found = CommandLine.of(arguments)
    assert found.overrides == line[0]
    assert found.config_dir == (line[1] if line[1:] else None)
    assert found.shown == found.resolved == ("--cfg" in arguments)


@pytest.mark.parametrize("argument", ["--shell-completion", "-sc", "--package=x", "--info"])
def test_unknown_options_are_refused_with_the_known_ones(argument):
    with pytest.raises(InputError, match=rf"^{argument}.*: estima run takes .*--config-dir"):
        CommandLine.of(["seed=1", argument])
    with pytest.raises(InputError, match=r"config-dir.*expected one argument"):
        CommandLine.of(["seed=1", "--config-dir"])


def test_a_key_that_is_set_twice_is_refused():
    with pytest.raises(InputError, match=r"^seed is set twice \(seed=1, seed=2\)"):
        CommandLine.of(["seed=1", "estimator=odometry", "seed=2"])


@pytest.mark.parametrize(
    "override", ["hydra.run.dir=x", "hydra/sweeper=ax", "hydra.verbose=true", "hydra.job.name=x"]
)
def test_settings_of_hydra_that_nothing_reads_are_refused(override):
    with pytest.raises(InputError, match=override.partition("=")[0]):
        check_overrides([override])


def test_a_number_of_too_many_digits_is_refused():
    check_overrides(["seed=" + "9" * 4300])
    with pytest.raises(InputError, match=r"^seed=9+\.\.\.: a number of more than 4300 digits"):
        check_overrides(["seed=" + "9" * 4301])


def test_a_cache_that_cannot_be_cleared_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    cache.folder().mkdir(parents=True)
    entry = cache.folder() / "a.npz"
    entry.write_bytes(b"x")

    def read_only(*_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(processes.fcntl, "flock", read_only)
    with pytest.raises(InputError, match=r"a\.lock: cannot lock it \(Read-only"):
        cache.trim(0.0)
    monkeypatch.undo()
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    assert cache.trim(0.0) == 1
    assert not entry.exists()
