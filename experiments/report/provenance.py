"""How each paper's results were made, results/provenance.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from experiments.runs.machine import machine
from experiments.runs.version import code_version
from sim.errors import InputError
from sim.files import write_whole

_KEYS = ("profile", "seconds", "code_version")
_REMEDY = "`git checkout results`, or delete it and run `estima reproduce`"


def read_provenance(results: Path) -> dict[str, dict[str, Any]]:
    """How each paper's results were made: profile, duration, code, machine; empty if unknown.

    Raises
    ------
    InputError
        If the file cannot be read, or a paper lacks a key.
    """
    path = results / "provenance.json"
    try:
        made: dict[str, dict[str, Any]] = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot read ({error}); {_REMEDY}") from error
    if not isinstance(made, dict):
        raise InputError(f"{path}: must hold an object by paper; {_REMEDY}")
    for paper, how in made.items():
        missing = [key for key in _KEYS if not isinstance(how, dict) or key not in how]
        if missing:
            raise InputError(f"{path}: {paper} does not say its {', '.join(missing)}; {_REMEDY}")
    return made


def note_provenance(results: Path, paper: str, profile: str, seconds: float) -> None:
    """Keep how a paper's results were made, beside them."""
    made = read_provenance(results)
    made[paper] = {"profile": profile, "seconds": round(seconds), **this_code()}
    with write_whole(results / "provenance.json") as part:
        part.write_text(json.dumps(dict(sorted(made.items())), indent=2) + "\n")


def this_code() -> dict[str, Any]:
    """Version of the code, and the machine it runs on."""
    return {"code_version": code_version(), **machine()}
