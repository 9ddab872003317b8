"""Options of models, data and trainer: what each may be stands beside it, in the fields of a dataclass."""

import math
import types
import typing
from collections.abc import Callable
from dataclasses import MISSING, field, fields, is_dataclass
from typing import Any

from rcnn_odom.errors import InputError

WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a word"}


def option(
    *,
    default: Any = MISSING,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    choices: tuple[str, ...] = (),
    fits: Callable[[Any], bool] | None = None,
    wanted: str = "",
) -> Any:
    """A field of an options dataclass, with its bounds.

    Args:
        default: makes it one that may be left out.
        above, least, below: bounds of a number: greater than, at least, less than.
        choices: words that are allowed.
        fits: a condition that no bound can say.
        wanted: in words what a value must be; None: told from the bounds.
    """
    bounds = {
        "above": above,
        "least": least,
        "below": below,
        "choices": choices,
        "fits": fits,
        "wanted": wanted,
    }
    return field(default=default, metadata=bounds)


def check_options(options: type, values: dict[str, Any], prefix: str, *, partly: bool = False) -> None:
    """Compares the values of options with their dataclass; nested groups with nested dataclasses.

    A field whose type admits None may be null. Fields with a default may be left out, and are
    filled in unless ``partly``.

    Args:
        options: a dataclass.
        values: plain values by name.
        prefix: of their names on the command line, ``model.``.
        partly: values may be missing, or refer to another by ``${...}``, and others that the dataclass does
            not know be there.

    Raises:
        InputError: an option is missing, unknown, of another type, or outside its bounds.
    """
    known = {each.name: each for each in fields(options)}
    types_of = typing.get_type_hints(options)
    for name in set() if partly else values.keys() - known.keys():
        raise InputError(f"{prefix}{name}: there is no such option; there are {', '.join(sorted(known))}")
    for name, each in known.items():
        if name not in values:
            if not partly and each.default is MISSING:
                raise InputError(
                    f"{prefix}{name} is missing; it may be that of an older version: train again"
                )
            if not partly:
                values[name] = each.default
        elif isinstance(values[name], dict) or not (partly and "${" in str(values[name])):
            _check(f"{prefix}{name}", values[name], types_of[name], each.metadata, partly)


def _check(name: str, value: Any, kind: Any, bounds: Any, partly: bool) -> None:
    if is_dataclass(kind):
        if not isinstance(value, dict):
            first = next(iter(fields(kind))).name
            raise InputError(f"{name}={value}: has parts to set, for instance {name}.{first}=...")
        check_options(kind, value, f"{name}.", partly=partly)  # type: ignore[arg-type]
        return
    is_union = typing.get_origin(kind) in (types.UnionType, typing.Union)
    allowed = typing.get_args(kind) if is_union else (kind,)
    if value is None and type(None) in allowed:
        return
    if not (_is_kind(value, allowed) and _within(value, bounds)):
        raise InputError(f"{name}={value}: {_wanted(allowed, bounds)}")


def _is_kind(value: Any, allowed: tuple[Any, ...]) -> bool:
    kinds = {typing.get_origin(kind) or kind for kind in allowed}
    if isinstance(value, bool) or value is None:
        return bool in kinds and value is not None
    if isinstance(value, int) and float in kinds:
        return True
    return type(value) in kinds and (not isinstance(value, float) or math.isfinite(value))


def _within(value: Any, bounds: Any) -> bool:
    if isinstance(value, bool):
        return True
    return (
        (bounds.get("above") is None or value > bounds["above"])
        and (bounds.get("least") is None or value >= bounds["least"])
        and (bounds.get("below") is None or value < bounds["below"])
        and (not bounds.get("choices") or value in bounds["choices"])
        and (bounds.get("fits") is None or bounds["fits"](value))
    )


def _wanted(allowed: tuple[Any, ...], bounds: Any) -> str:
    """In words what a value must be."""
    if bounds.get("wanted"):
        return f"must be {bounds['wanted']}"
    if bounds.get("choices"):
        return f"choose one of {', '.join(bounds['choices'])}"
    kinds = ["null" if kind is type(None) else WORDS.get(kind, str(kind)) for kind in allowed]
    words = " or ".join(sorted(kinds, key="null".__ne__))
    limits = [
        f"{text} {bounds[key]:g}"
        for key, text in (("above", "above"), ("least", "from"), ("below", "below"))
        if bounds.get(key) is not None
    ]
    return f"must be {words} {' and '.join(limits)}".rstrip()
