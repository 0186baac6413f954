"""YAML files that may come from anywhere: read within bounds, and no key twice."""

import math
import re
from pathlib import Path
from typing import Any

import yaml

from sim.errors import InputError, require
from sim.files import require_file

MOST_BYTES = 10_000_000
_MOST_NODES = 1_000_000  # after aliases are followed: nine lines can stand for a billion
_MOST_DEPTH = 50
# What PyYAML raises for a document, or for a value that is not what its tag says
_MALFORMED = (yaml.YAMLError, ValueError, TypeError, AttributeError, LookupError, OverflowError)


def read_yaml(path: Path, most_bytes: int = MOST_BYTES) -> Any:
    """Read a document of plain values.

    Raises
    ------
    InputError
        If the file cannot be read, is too long, nested too deeply, stands for too much, has a key
        twice, or is not YAML; in one line that names the place.
    """
    require_file(path)
    try:
        with path.open("rb") as file:
            text = file.read(most_bytes + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot read ({error.strerror}); check its name") from error
    require(len(text) <= most_bytes, f"{path}: longer than {most_bytes} bytes")
    loader = None
    try:
        loader = yaml.SafeLoader(text.decode())
        root = loader.get_single_node()
        if root is None:
            return None
        _check(root, path)
        return loader.construct_document(root)
    except RecursionError:
        raise InputError(f"{path}: nested more than {_MOST_DEPTH} deep") from None
    except _MALFORMED as error:
        where = getattr(error, "problem_mark", None)
        line = f":{where.line + 1}" if where is not None else ""
        brief = " ".join(str(getattr(error, "problem", None) or error).split())[:120]
        raise InputError(f"{path}{line}: not valid YAML ({brief})") from error
    finally:
        if loader is not None:
            loader.dispose()


def number(value: Any, where: str) -> float:
    """Return a finite number; YAML 1.1 reads 1e-3, without a point, as text.

    Raises
    ------
    InputError
        If it is not one.
    """
    try:
        found = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    require(math.isfinite(found), f"{where} must be a finite number, got {shown(value)}")
    return found


def shown(value: Any) -> str:
    """A value for a message; of lists and mappings, which YAML can make endless, their size."""
    if isinstance(value, (list, dict)):
        return f"a {type(value).__name__} of {len(value)}"
    return repr(value)[:80]


def _check(root: yaml.Node, path: Path) -> None:
    """Walk through a document as its aliases unfold it, and refuse what is out of bounds."""
    seen, nodes = 0, [(root, 0)]
    while nodes:
        node, depth = nodes.pop()
        seen += 1
        line = f"{path}:{node.start_mark.line + 1}"
        if isinstance(node, yaml.ScalarNode):  # which names of files may not hold
            odd = re.search("[\0\ud800-\udfff]", node.value)
            require(odd is None, f"{line}: holds a zero byte or half a character; remove it")
        require(depth <= _MOST_DEPTH, f"{line}: nested more than {_MOST_DEPTH} deep")
        require(
            seen <= _MOST_NODES, f"{line}: its aliases (*) stand for more than {_MOST_NODES} values"
        )
        if isinstance(node, yaml.MappingNode):
            names = set()
            for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
                there = f"{path}:{key.start_mark.line + 1}: the key {key.value} is there twice"
                require(key.value not in names, f"{there}; keep one")
                names.add(key.value)
            nodes += [(part, depth + 1) for pair in node.value for part in pair]
        elif isinstance(node, yaml.SequenceNode):
            nodes += [(part, depth + 1) for part in node.value]
