"""What a study writes for its claims and figures, by its size: tables and arrays."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from experiments.judging import folders
from experiments.runs.paths import short
from experiments.runs.row import read_rows, write_frame
from sim.errors import InputError
from sim.files import write_whole
from sim.npz import read_arrays

Arrays = dict[str, NDArray[Any]]
# Errors of a table or array without its content; a query for a missing column is a NameError
_MISFITS = (
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    pd.errors.UndefinedVariableError,
    EOFError,
)


def write_table(frame: pd.DataFrame, path: Path) -> None:
    """Write a table of a study, its numbers with twelve digits."""
    write_frame(frame, path, digits=12)


class Profile(StrEnum):
    """The size of a study: `quick` makes all from few repeats, on tuning seeds."""

    FULL = "full"
    QUICK = "quick"


FIRST_SEED = {Profile.FULL: 2000, Profile.QUICK: 0}  # of the worlds; those below 100 are for tuning


def first_seed(study: str, claim: str, profile: Profile) -> int:
    """Seed of the first world of a claim's own runs; design.yaml names fresh ones in `seeds`."""
    fresh = folders.design(study).get("seeds", {}) if profile is Profile.FULL else {}
    return int(fresh.get(claim, FIRST_SEED[profile]))


@dataclass(frozen=True)
class Results:
    """A study's files in a folder: `tables/PAPER_NAME.csv` and `arrays/PAPER_NAME.npz`.

    Claims and figures are made from these alone, so what is on disk is what is judged and drawn.
    """

    folder: Path
    paper: str

    def write_tables(self, **frames: pd.DataFrame) -> None:
        """Write tables by name."""
        for name, frame in frames.items():
            write_table(frame, self._path("tables", f"{name}.csv"))

    def table(self, name: str) -> pd.DataFrame:
        """Read a table.

        Raises
        ------
        InputError
            If it is missing or damaged, or has no rows.
        """
        path = self._path("tables", f"{name}.csv", to_read=True)
        table = read_rows(path, self._remedy)
        if table.empty:
            raise InputError(f"{short(path)}: damaged (no rows); {self._remedy}")
        return table

    def optional_table(self, name: str) -> pd.DataFrame | None:
        """Read a table that needs data which is not part of the project; None without it."""
        return self.table(name) if self._path("tables", f"{name}.csv").exists() else None

    def write_arrays(self, name: str, **arrays: NDArray[np.generic]) -> None:
        """Write named arrays to one file, compressed."""
        with write_whole(self._path("arrays", f"{name}.npz")) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    def arrays(self, name: str) -> Arrays:
        """Read named arrays.

        Raises
        ------
        InputError
            If they are missing or damaged, or one is asked for that is not among them.
        """
        path = self._path("arrays", f"{name}.npz", to_read=True)
        try:
            return _Arrays(read_arrays(path), short(path), self._remedy)
        except InputError as error:
            raise InputError(f"{short(path)}: damaged ({error}); {self._remedy}") from error

    def has_arrays(self, name: str) -> bool:
        """Whether the study left these arrays, or they came with the project."""
        return self._path("arrays", f"{name}.npz").exists()

    @contextmanager
    def blaming_files(self) -> Iterator[None]:
        """Report errors in derived claims and figures as damaged files on disk.

        Raises
        ------
        InputError
            If their content is not what the claims or figures expect.
        """
        try:
            yield
        except _MISFITS as error:
            why = (str(error).splitlines() or [type(error).__name__])[0]
            if isinstance(error, KeyError):
                why = f"{why} missing"
            raise InputError(
                f"{short(self.folder)}: the tables or arrays of {self.paper} are damaged or of "
                f"another version ({why}); {self._remedy}"
            ) from error

    def _path(self, kind: str, name: str, *, to_read: bool = False) -> Path:
        path = self.folder / kind / f"{self.paper}_{name}"
        if to_read and not path.exists():
            raise InputError(f"{short(path)}: missing; {self._remedy}")
        return path

    @property
    def _remedy(self) -> str:
        return f"run `{reproduce_command(self.paper)}`"


def reproduce_command(paper: str | None) -> str:
    """The command that makes a paper's results again, or those of all papers."""
    return f"estima reproduce{f' --paper {paper}' if paper else ''} --full"


class _Arrays(Arrays):
    """Arrays of a file; asking for a missing one raises an error that names the file."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]], file: str, remedy: str) -> None:
        super().__init__(arrays)
        self._file, self._remedy = file, remedy

    def __missing__(self, name: str) -> NDArray[Any]:
        raise InputError(
            f"{self._file}: damaged or of another version ({name!r} missing); {self._remedy}"
        )
