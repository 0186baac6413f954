"""What a study leaves on disk for its claims and figures: tables, and arrays."""

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
    """A study's files: `tables/PAPER_NAME.csv` and `arrays/PAPER_NAME.npz` of a folder.

    Claims and figures are made from these alone, so what is judged and drawn is what is on disk.
    """

    folder: Path
    paper: str

    def write_table(self, name: str, frame: pd.DataFrame) -> None:
        """Write a table."""
        write_frame(frame, self.folder / "tables" / f"{self.paper}_{name}.csv", digits=12)

    def table(self, name: str) -> pd.DataFrame:
        """Read a table.

        Raises
        ------
        InputError
            If it is missing or damaged.
        """
        path = self.folder / "tables" / f"{self.paper}_{name}.csv"
        if not path.exists():
            raise InputError(f"{path}: missing; run `estima reproduce --paper {self.paper}`")
        return read_rows(path)

    def write_arrays(self, name: str, **arrays: NDArray[np.generic]) -> None:
        """Write named arrays, compressed."""
        path = self.folder / "arrays" / f"{self.paper}_{name}.npz"
        with write_whole(path) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    def arrays(self, name: str) -> dict[str, NDArray[np.generic]]:
        """Read named arrays.

        Raises
        ------
        InputError
            If they are missing or damaged.
        """
        path = self.folder / "arrays" / f"{self.paper}_{name}.npz"
        remedy = f"run `estima reproduce --paper {self.paper}`"
        try:
            with np.load(path, allow_pickle=False) as file:
                return dict(file)
        except FileNotFoundError:
            raise InputError(f"{path}: missing; {remedy}") from None
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: damaged ({error}); {remedy}") from error
