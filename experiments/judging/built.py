"""What each table, figure and verdict was made from: results/built.json, and what is stale."""

import json
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from experiments.judging.claims_file import read_provenance, read_verdicts
from experiments.judging.folders import STUDIES, SWEEPS
from experiments.runs.dependencies.digests import changed, digest_of, name_of
from experiments.runs.dependencies.recorder import Digests, Recorder, digest_of_all
from experiments.runs.paths import SOURCE
from sim.errors import InputError, require
from sim.files import require_file, write_whole

_FILE = "built.json"
_REMEDY = "restore it by `git checkout`, or delete it"
_MOST_NAMED = 3


class State(StrEnum):
    """Whether a result is what this code would make.

    `unrecorded`: nothing says what it was made from, so it counts as stale.
    """

    FRESH = "fresh"
    STALE = "stale"
    UNRECORDED = "unrecorded"


@dataclass(frozen=True)
class Built:
    """A table, figure or verdict, and how it was made.

    Attributes
    ----------
    study, name
        Its study, and its path in the results or the claim's id.
    commit
        That it was made from, or the code's version; with a + if files were changed since.
    seconds
        That its jobs took, added up; of what is made together, of all of it.
    why
        What has changed.
    """

    study: str
    name: str
    state: State
    commit: str = "?"
    seconds: float | None = None
    why: Sequence[str] = ()

    def __str__(self) -> str:
        cost = "" if self.seconds is None else f"{self.seconds:.0f} s"
        more = f" and {len(self.why) - _MOST_NAMED} more" if len(self.why) > _MOST_NAMED else ""
        why = f"  {', '.join(self.why[:_MOST_NAMED])}{more}" if self.why else ""
        return f"{self.state:<10} {self.name:<52} {self.commit:<12} {cost:>8}{why}"


def list_built(results: Path) -> list[Built]:
    """Every table, figure and verdict there is.

    Raises
    ------
    InputError
        If a file that says how they were made is damaged.
    """
    kept, made = _read(results), read_provenance(results)
    named = [
        (study_of(path.stem), f"{path.parent.name}/{path.name}")
        for kind in ("tables", "figures")
        for path in sorted((results / kind).glob("*.*"))
    ]
    verdicts = read_verdicts(results / "verdicts.csv")
    named += [(str(row["paper"]), str(row["id"])) for _, row in verdicts.iterrows()]
    return [_state(kept, study, name, made.get(study, {})) for study, name in named]


def study_of(stem: str) -> str:
    """The study that a file belongs to, by its name."""
    found = [study for study in (*STUDIES, *SWEEPS) if stem.startswith(f"{study}_")]
    return found[0] if found else stem.partition("_")[0]


def _state(kept: Mapping[str, Any], study: str, name: str, made: Mapping[str, Any]) -> Built:
    item = kept["items"].get(name)
    if item is None:
        return Built(
            study, name, State.UNRECORDED, f"code {str(made.get('code_version', '?'))[:7]}"
        )
    why = changed(kept["sets"][item["set"]])
    state = State.STALE if why else State.FRESH
    return Built(study, name, state, item["commit"], item["seconds"], why)


def note_built(
    results: Path,
    study: str,
    items: Mapping[str, tuple[Digests, float]],
    *,
    only_these: bool = False,
) -> None:
    """Record what each of a study's results depends on and the seconds that it took.

    Parameters
    ----------
    only_these
        Forget the study's others, which it no longer makes.
    """
    kept, commit = _read(results), this_commit()
    others = {
        name: item
        for name, item in kept["items"].items()
        if item["study"] != study or not only_these
    }
    own = {}
    for name, (digests, seconds) in items.items():
        key = digest_of_all(digests)
        kept["sets"][key] = dict(digests)
        item = {"study": study, "set": key, "commit": commit, "seconds": round(seconds, 1)}
        own[name] = item
    whole = {**others, **own}
    used = {item["set"] for item in whole.values()}
    sets = {key: digests for key, digests in sorted(kept["sets"].items()) if key in used}
    with write_whole(results / _FILE) as part:
        found = {"items": dict(sorted(whole.items())), "sets": sets}
        part.write_text(json.dumps(found, indent=1) + "\n")


def dependencies_of(seen: Recorder, folder: Path) -> dict[str, str]:
    """What was recorded; files of a folder that stands for that of the results, as its own."""
    read = [path for path in map(Path, seen.read) if path.is_relative_to(folder)]
    ours = {
        f"results/{path.relative_to(folder)}": digest_of(path) for path in read if path.is_file()
    }
    here = name_of(folder)
    return {n: d for n, d in seen.digests().items() if not n.startswith(f"{here}/")} | ours


def table_dependencies(seen: Recorder, folder: Path) -> dict[str, tuple[dict[str, str], float]]:
    """What each table in a folder depends on, and its seconds.

    One that is made from others in the end depends on all that they depend on.
    """
    own = dependencies_of(seen, folder)
    every = {name: digest for part, _ in seen.parts.values() for name, digest in part.items()}
    whole_s = sum(seconds for _, seconds in seen.parts.values())
    found = {}
    for path in sorted((folder / "tables").glob("*.csv")):
        table = path.stem.removeprefix(f"{study_of(path.stem)}_")
        digests, seconds = seen.parts.get(table, (every, whole_s))
        found[f"tables/{path.name}"] = own | digests, seconds
    return found


def this_commit() -> str:
    """The commit that is checked out, with a + if files differ from it; `?` without Git."""
    try:
        said = [
            subprocess.run(["git", *words], cwd=SOURCE, capture_output=True, text=True, check=True)
            for words in (["rev-parse", "HEAD"], ["status", "-s", "-uno"])
        ]
    except (OSError, subprocess.CalledProcessError):
        return "?"
    commit, files = (each.stdout.strip() for each in said)
    edited = [line for line in files.splitlines() if " results/" not in f" {line}"]
    return commit[:10] + "+" * bool(edited)


def _read(results: Path) -> dict[str, Any]:
    """What built.json holds, checked."""
    path = results / _FILE
    require_file(path)
    try:
        found = json.loads(path.read_text())
        for item in found["items"].values():
            sound = isinstance(found["sets"][item["set"]], dict)
            sound &= isinstance(item["commit"], str) and isinstance(item["study"], str)
            require(sound and item["seconds"] >= 0.0, "a field of another type")
    except FileNotFoundError:
        return {"items": {}, "sets": {}}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: cannot read it ({error!r}); {_REMEDY}") from error
    return {"items": dict(found["items"]), "sets": dict(found["sets"])}
