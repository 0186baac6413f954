"""Runs whose programs and packages are here, and what to say of the others."""

from collections.abc import Iterable

from estimators.peers import MissingPackageError
from experiments.runs.console import warn
from experiments.runs.experiment import Experiment


def why_absent(experiment: Experiment) -> str:
    """Why the estimator of a run is not here; empty if it is.

    Raises
    ------
    InputError
        If the configuration is wrong.
    """
    try:
        experiment.check()
    except MissingPackageError as error:
        return str(error)
    return ""


def find_absent(experiments: Iterable[Experiment]) -> dict[str, str]:
    """Estimators of these runs that are not here, and why; each is warned of."""
    one_each = {experiment.estimator_name: experiment for experiment in experiments}
    absent = {name: why for name, experiment in one_each.items() if (why := why_absent(experiment))}
    for name, reason in absent.items():
        warn(f"{name}: left out, {reason}")
    return absent


def installed(experiments: Iterable[Experiment]) -> list[Experiment]:
    """Those of these runs whose estimators are here; the others are warned of."""
    given = list(experiments)
    absent = find_absent(given)
    return [one for one in given if one.estimator_name not in absent]
