"""Where the package keeps its own data, and where results go."""

import itertools
import os
import re
from pathlib import Path
from typing import Any

from sim.errors import require
from sim.files import read_text

TRUST = "ESTIMA_TRUST"  # set by --trust: data may name code
SOURCE = Path(__file__).resolve().parents[2]  # the clone, or the site-packages of a wheel


def is_trusting() -> bool:
    """Whether the user has said that data may name code."""
    return os.environ.get(TRUST) == "1"


def packaged(name: str) -> Path:
    """Return a folder that travels with the code: `conf`, or `results/baselines`.

    A wheel holds them in experiments/packaged/, a clone at its top level.
    """
    inside = SOURCE / "experiments" / "packaged" / name
    return inside if inside.exists() else SOURCE / name


CONF = packaged("conf")


def option_names(group: str, folder: Path | None = None) -> list[str]:
    """Options of a group of the configuration, such as `office` and `gil2008/particles`.

    Parameters
    ----------
    folder
        Folder of the groups; by default that of the package.
    """
    place = (folder or CONF) / group
    return sorted(p.relative_to(place).with_suffix("").as_posix() for p in place.rglob("*.yaml"))


def about(file: Path) -> dict[str, str]:
    """What the comment at the head of an option's YAML says.

    Returns
    -------
    dict
        `what` it is, the first sentence; and what it is `not_for`, the sentence after "Not for:".
    """
    lines = read_text(file).splitlines()
    head = itertools.takewhile(lambda line: line.startswith("#"), lines)
    words = " ".join(line.lstrip("# ") for line in head if "@package" not in line)
    text, _, limits = words.partition(" Not for: ")
    first = re.split(r"(?<!sec)\. +(?=[A-Z])", text, maxsplit=1)[0]  # not at "eqs. (1)"
    return {"what": first.removesuffix("."), "not_for": limits}


def results() -> Path:
    """Return the folder of results: `results` in the current folder, or $ESTIMA_RESULTS."""
    return Path.cwd() / (os.environ.get("ESTIMA_RESULTS") or "results")


def rows_folder(name: Any) -> Path:
    """Folder of rows of a name.

    Raises
    ------
    InputError
        If the name is not one word.
    """
    require(
        isinstance(name, str) and re.fullmatch(r"[\w.-]*\w", name),
        f"name must be one word for a folder of results, such as slip_2, got {name!r}",
    )
    return results() / "runs" / str(name)


def short(path: Path) -> str:
    """Return the path as one would type it from here."""
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def quoted(text: object) -> str:
    """Return the text as a value of a Hydra override, whatever letters a path has."""
    from hydra.core.override_parser.types import Quote, QuotedString

    # no interpolation; a \ before one counts double
    plain = re.sub(r"(\\*)\$\{", r"\1\1\\${", str(text))
    return QuotedString(plain, Quote.single).with_quotes()
