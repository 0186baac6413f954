"""Methods of other projects behind the protocol of `estimators.base`: one thin adapter a file."""

import importlib
from typing import Any

from sim.errors import InputError


class MissingPackageError(InputError):
    """A peer's package or program is not installed."""


def package(name: str, extra: str) -> Any:
    """Import a peer's package.

    Raises
    ------
    MissingPackageError
        If it is not installed; naming the extra that brings it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingPackageError(
            f"{name} cannot be imported ({error}); pip install 'estima[{extra}]'"
        ) from error
