"""What a study writes for its claims and figures: tables and arrays."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from experiments.runs.row import read_rows, write_frame
from sim.errors import InputError
from sim.files import write_whole


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
            write_frame(frame, self._path("tables", f"{name}.csv"), digits=12)

    def table(self, name: str) -> pd.DataFrame:
        """Read a table.

        Raises
        ------
        InputError
            If it is missing or damaged.
        """
        return read_rows(self._path("tables", f"{name}.csv", to_read=True))

    def write_arrays(self, name: str, **arrays: NDArray[np.generic]) -> None:
        """Write named arrays to one file, compressed."""
        with write_whole(self._path("arrays", f"{name}.npz")) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    def arrays(self, name: str) -> dict[str, NDArray[np.generic]]:
        """Read named arrays.

        Raises
        ------
        InputError
            If they are missing or damaged.
        """
        path = self._path("arrays", f"{name}.npz", to_read=True)
        try:
            with np.load(path, allow_pickle=False) as file:
                return dict(file)
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: damaged ({error}); {self._remedy}") from error

    def _path(self, kind: str, name: str, *, to_read: bool = False) -> Path:
        path = self.folder / kind / f"{self.paper}_{name}"
        if to_read and not path.exists():
            raise InputError(f"{path}: missing; {self._remedy}")
        return path

    @property
    def _remedy(self) -> str:
        return f"run `estima reproduce --paper {self.paper}`"
