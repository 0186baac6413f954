"""Python sources as results depend on them: what they say, whatever their comments, and import.

Reading a source takes milliseconds, so what was read is kept in results/cache/sources.json, by the
digest of its text.
"""

import ast
import functools
import hashlib
import importlib.util
import json
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from experiments.runs.paths import results
from sim.errors import InputError
from sim.files import write_whole


class Source(NamedTuple):
    """What counts of a Python source.

    Attributes
    ----------
    digest
        Of its statements without comments, docstrings and layout.
    imports
        Modules, and names that may be modules, that its import statements outside functions name;
        relative ones with their dots.
    every
        The same of all import statements.
    """

    digest: str
    imports: tuple[str, ...]
    every: tuple[str, ...]


def read_source(text: bytes) -> Source:
    """Digest and imports of a source; of one that does not parse, the digest of its text."""
    key = hashlib.sha256(text).hexdigest()[:24]
    known = _known(results() / "cache" / "sources.json")
    if key not in known:
        try:
            tree = ast.parse(text)
            imports = tuple(sorted(set(_imports(tree.body))))
            kinds = ast.Import | ast.ImportFrom
            nodes = (node for node in ast.walk(tree) if isinstance(node, kinds))
            every = tuple(sorted(set(_imports(nodes))))
            said = ast.dump(_without_docstrings(tree)).replace(", type_params=[]", "")
            known[key] = Source(hashlib.sha256(said.encode()).hexdigest()[:16], imports, every)
        except (SyntaxError, ValueError, RecursionError):
            known[key] = Source(key[:16], (), ())
    return known[key]


def keep_sources() -> None:
    """Keep what was read for other processes, if there is anything new."""
    path = results() / "cache" / "sources.json"
    known = _known(path)
    if len(known) > known.kept:
        with suppress(InputError), write_whole(path, durable=False) as part:
            part.write_text(json.dumps(known))
        known.kept = len(known)


class _Known(dict[str, Source]):
    """Sources by the digest of their text, and how many of them the file has."""

    kept = 0


@functools.cache
def _known(path: Path) -> _Known:
    known = _Known()
    with suppress(OSError, ValueError, TypeError, RecursionError):
        text = path.read_text() if path.is_file() else "{}"  # a pipe would wait forever
        for key, (digest, imports, every) in json.loads(text).items():
            if isinstance(digest, str) and all(isinstance(name, str) for name in imports + every):
                known[key] = Source(digest, tuple(imports), tuple(every))
    known.kept = len(known)
    return known


def _without_docstrings(tree: ast.Module) -> ast.Module:
    """The tree without statements that are only texts, wherever they stand."""
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [each for each in body if not _is_docstring(each)]  # type: ignore[attr-defined]
    return tree


def resolved(names: Iterable[str], package: str) -> set[str]:
    """Imports of a source in this package, without their leading dots."""
    found = set()
    for name in names:
        with suppress(ImportError):
            found.add(importlib.util.resolve_name(name, package))
    return found


def _is_docstring(node: Any) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _imports(body: Iterable[ast.stmt]) -> Iterator[str]:
    """What a module's statements import when it is loaded."""
    for node in body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            yield base
            yield from (f"{(base.rstrip('.') and base + '.') or base}{a.name}" for a in node.names)
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            yield from _imports(node.orelse)
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            for part in ("body", "orelse", "finalbody"):
                yield from _imports(getattr(node, part, []))
            for handler in getattr(node, "handlers", []):
                yield from _imports(handler.body)
