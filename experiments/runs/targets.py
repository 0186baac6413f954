"""Objects that a configuration names by `_target_`, and the code that it names at all."""

import inspect
import json
from collections.abc import Callable, Collection, Mapping
from typing import Any

from sim.errors import InputError, blaming, describe_unknown, require
from sim.options import find


def make(settings: Mapping[str, Any], where: str, **injected: Any) -> Any:
    """Call what `_target_` names with the other keys.

    Parameters
    ----------
    settings
        A mapping with `_target_` (module.name) and keyword arguments.
    where
        Its place in the configuration, for messages.
    injected
        Further arguments that the program passes if the target accepts them.

    Raises
    ------
    InputError
        If the target cannot be found, or a key is unknown or missing.
    """
    function = check_target(settings, where, injected)
    arguments = {key: value for key, value in settings.items() if key != "_target_"}
    known = inspect.signature(function).parameters
    with blaming(f"{where} ({settings['_target_']})"):
        try:
            return function(**arguments, **{k: v for k, v in injected.items() if k in known})
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{where} ({settings['_target_']}) does not accept its values: {error}"
            ) from error


def check_target(
    settings: Mapping[str, Any], where: str, injected: Collection[str] = ()
) -> Callable[..., Any]:
    """Return what `_target_` names, if it takes the other keys; `make` says more.

    Raises
    ------
    InputError
        If the target cannot be found, a key is unknown or missing, or a word stands for a number.
    """
    function = find(settings.get("_target_"), where)
    target = settings["_target_"]
    known = inspect.signature(function).parameters
    variadic = {name for name, p in known.items() if p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
    open_ended = any(p.kind is p.VAR_KEYWORD for p in known.values())
    free = [name for name in known if name not in injected]
    for key in settings:
        if not open_ended and key not in known and key != "_target_":
            raise InputError(describe_unknown(key, free, where))
    for name, parameter in known.items():
        if name in settings:
            kind = getattr(parameter.annotation, "__name__", str(parameter.annotation))
            number = kind.removesuffix(" | None") in ("int", "float")
            require(
                not (number and isinstance(settings[name], str)),
                f"{where}.{name} must be a number, got {settings[name]!r}",
            )
        elif name not in {*variadic, *injected, "self"}:
            bare = parameter.default is parameter.empty
            require(not bare, f"{where}.{name} is missing; {target} needs it")
    return function


def named_code(tree: Any) -> set[str]:
    """Every `_target_` and `command` in mappings and lists; commands as a row has them."""
    if isinstance(tree, (list, tuple)):
        return set().union(*map(named_code, tree))
    if not isinstance(tree, Mapping):
        return set()
    here = {
        value if isinstance(value, str) else json.dumps(value, default=str)
        for key, value in tree.items()
        if key in ("_target_", "command") and value not in (None, "???")  # given later
    }
    return here.union(*map(named_code, tree.values()))
