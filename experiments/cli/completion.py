"""Words that the shell completes: options, overrides, estimators, sweeps, metrics.

Nothing heavy is imported here, since a shell waits for it.
"""

import re
from collections.abc import Iterable
from pathlib import Path

from experiments.runs import columns, paths

GROUPS = ("world", "robot", "sensors", "route", "estimator", "study")
_KEY = re.compile(r"^( *)(\w+):", re.MULTILINE)
_CHOICES = {
    "simulation.physics": ("bullet", "kinematic"),
    "simulation.rays": ("bullet", "exact"),
    "prior.start": ("tracking", "global"),
    "prior.map": ("none", "world"),
    "picture": ("true", "false"),
}


def overrides(incomplete: str) -> list[str]:
    """Hydra overrides: groups and their options, keys, and values of some keys."""
    start = re.match(r"[+~]*", incomplete)
    prefix = start[0] if start else ""
    word = incomplete.removeprefix(prefix)
    key, equals, _ = word.partition("=")
    if equals:
        known: Iterable[str] = options(key) if key in GROUPS else _CHOICES.get(key, ())
        found = [f"{key}={value}" for value in known]
    else:
        group = word.partition(".")[0]
        files = (paths.CONF / group).glob("*.yaml") if "." in word and group in GROUPS else ()
        inside = {name for path in files for name in _keys(path)}
        found = [f"{name}=" for name in (*GROUPS, *_keys(paths.CONF / "config.yaml"))]
        found += [f"{group}.{name}=" for name in inside]
    return sorted({prefix + text for text in found if text.startswith(word)})


def options(group: str) -> list[str]:
    """Options of a group of the configuration."""
    return paths.option_names(group)


def estimators(incomplete: str) -> list[str]:
    """Options of conf/estimator."""
    return [name for name in options("estimator") if name.startswith(incomplete)]


def studies(incomplete: str) -> list[str]:
    """Options of conf/study."""
    return [name for name in options("study") if name.startswith(incomplete)]


def groups(incomplete: str) -> list[str]:
    """What `estima options` lists."""
    return [name for name in (*GROUPS, "metrics") if name.startswith(incomplete)]


def suites(incomplete: str) -> list[str]:
    """Suites of conf/suite, and YAML files."""
    own = [str(path) for path in Path().glob("*.yaml")]
    return [name for name in (*options("suite"), *own) if name.startswith(incomplete)]


def sweeps(incomplete: str) -> list[str]:
    """Names of folders of rows in results/runs."""
    there = sorted(path.name for path in (paths.results() / "runs").glob("*") if path.is_dir())
    return [name for name in there if name.startswith(incomplete)]


def metrics(incomplete: str) -> list[str]:
    """Metrics of a run."""
    return [name for name in columns.COLUMNS if name.startswith(incomplete)]


def settings(incomplete: str) -> list[str]:
    """Columns that state a setting: choices and keys."""
    found = {f"choice.{group}" for group in GROUPS if group != "study"}
    found |= {text.removesuffix("=") for text in overrides(incomplete)} - set(GROUPS)
    return sorted(name for name in found if name.startswith(incomplete))


def _keys(path: Path) -> list[str]:
    """Dotted keys of a YAML file of mappings that are indented by two."""
    places: list[str] = []
    found = []
    for indent, name in _KEY.findall(path.read_text(encoding="utf-8")):
        places[len(indent) // 2 :] = [name]
        found.append(".".join(places))
    passed = ("defaults", "hydra", "sweeps", "tune")
    return [name for name in found if name.partition(".")[0] not in passed]
