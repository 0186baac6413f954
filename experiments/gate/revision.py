"""A suite at another revision of the code, or of the clone that the suite lies in."""

import json
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from experiments.bench.against import run_in

_ROWS = """
import json, sys
from pathlib import Path
from experiments.gate.suite import read_suite, run_suite
path, names, reseed, options = json.loads(sys.argv[1])
suite = read_suite(Path(path), *map(Path, options))
chosen = [entry for entry in suite.estimators if not names or entry.name in names]
repeats = {e.name: e.repeats[0] for e in chosen if not getattr(e, "elsewhere", False)}
print(run_suite(suite, repeats, reseed=reseed).to_json(orient="records", double_precision=15))
"""


def rows_in(
    folder: Path,
    suite: Path,
    names: Sequence[str],
    seeding: int = 0,
    config_dir: Path | None = None,
) -> pd.DataFrame:
    """Rows of a suite's estimators (all if none is named) by the code of a folder.

    A relative `config_dir` is that of the folder.

    Raises
    ------
    InputError
        If the suite does not run there.
    """
    options = [] if config_dir is None else [str(config_dir)]
    given = json.dumps([str(suite), list(names), seeding, options])
    return pd.DataFrame(run_in(folder, _ROWS, given))
