"""Objects that a configuration names by `_target_`."""

import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Any

from sim.errors import InputError
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
    function = checked(settings, where, injected)
    arguments = {key: value for key, value in settings.items() if key != "_target_"}
    known = inspect.signature(function).parameters
    try:
        return function(**arguments, **{k: v for k, v in injected.items() if k in known})
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{where} ({settings['_target_']}) does not accept its values: {error}"
        ) from error


def _is_number(annotation: Any) -> bool:
    """Whether a parameter takes a number or nothing."""
    name = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", "")
    return name.removesuffix(" | None") in ("int", "float")


def checked(
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
    variadic = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in known.values())
    for key, value in settings.items():
        if key in known and isinstance(value, str) and _is_number(known[key].annotation):
            raise InputError(f"{where}.{key} must be a number, got {value!r}")
        if key not in (*known, "_target_") and not open_ended:
            free = ", ".join(k for k in known if k not in injected) or "none"
            raise InputError(f"unknown key {where}.{key} for {target}; known: {free}")
    for name, parameter in known.items():
        required = parameter.default is inspect.Parameter.empty and parameter.kind not in variadic
        if required and name not in settings and name not in injected and name != "self":
            raise InputError(f"{where}.{name} is missing; {target} needs it")
    return function


def targets(tree: Any) -> set[str]:
    """Every `_target_` of a configuration."""
    if not isinstance(tree, Mapping):
        return set()
    here = {tree["_target_"]} if isinstance(tree.get("_target_"), str) else set()
    return here.union(*(targets(value) for value in tree.values()))
