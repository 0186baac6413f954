"""Command lines that Hydra itself would not understand, ignore, or end with a trace."""

import pytest

from experiments.runs import cache
from experiments.runs.compose import searched
from experiments.runs.console import end
from experiments.runs.experiment import Experiment
from experiments.runs.run import _split, application
from sim.errors import InputError


@pytest.mark.parametrize("options", [{"e": "[e]"}, {"e": "[f]", "f": "[e]"}])
def test_an_option_that_includes_itself_is_one_line(tmp_path, capsys, options):
    (tmp_path / "estimator").mkdir()
    for name, defaults in options.items():
        (tmp_path / "estimator" / f"{name}.yaml").write_text(f"defaults: {defaults}\n")
    with pytest.raises(RecursionError) as raised:
        Experiment.compose([*searched(tmp_path), "estimator=e"])
    with pytest.raises(SystemExit, match="2"):
        end(raised.value)
    assert capsys.readouterr().err.count("\n") == 1


def test_another_endless_recursion_is_an_internal_error(capsys):
    def descend():
        descend()

    with pytest.raises(RecursionError) as raised:
        descend()
    with pytest.raises(SystemExit, match="3"):
        end(raised.value)
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "overrides"),
    [
        (["seed=1", "--config-dir", "a=b", "estimator=x"], ["seed=1", "estimator=x"]),
        (["~route", "--resolve", "seed=1", "--cfg", "job", "a=2"], ["~route", "seed=1", "a=2"]),
        (["--config-dir=a", "seed=1"], ["seed=1"]),
    ],
)
def test_overrides_may_stand_before_and_after_options(arguments, overrides):
    found, options = _split(arguments)
    assert found == overrides
    assert options == [argument for argument in arguments if argument not in overrides]


@pytest.mark.parametrize("argument", ["--shell-completion", "-sc", "--package=x", "-p"])
def test_options_of_hydra_that_have_no_effect_are_refused(argument):
    with pytest.raises(InputError, match=r"--install-completion|without --cfg"):
        application(["seed=1", argument, "robot"], draw=lambda *_: None)


def test_a_cache_that_cannot_be_cleared_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    cache.folder().mkdir(parents=True)
    entry = cache.folder() / "a.npz"
    entry.write_bytes(b"x")

    def read_only(*_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(cache.fcntl, "flock", read_only)
    with pytest.raises(InputError, match=r"a\.npz: cannot delete it \(Read-only"):
        cache.trim(0.0)
    monkeypatch.undo()
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    assert cache.trim(0.0) == 1
    assert not entry.exists()
