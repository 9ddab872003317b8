"""Options of models, data and trainer: fields of a dataclass, each with the values that it allows."""

import math
import types
import typing
from collections.abc import Callable
from dataclasses import MISSING, field, fields, is_dataclass
from typing import Any

from rcnn_odom.errors import InputError

TYPE_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}


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
        default: value of an option that the user leaves out; without a default the option is required.
        above, least, below: bounds of a number: greater than, at least, less than.
        choices: the allowed texts.
        fits: a condition that the bounds cannot express.
        wanted: describes the allowed values for the error message, which says ``must be WANTED``; if empty,
            the description is made from the type and the bounds.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass
        ... class Options:
        ...     kernel_size: int = option(fits=lambda size: size % 2 == 1, wanted="odd")
        ...     dropout: float = option(least=0, below=1, default=0.0)
        >>> Options(kernel_size=3)
        Options(kernel_size=3, dropout=0.0)
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
    """Checks the values of options against their dataclass; nested groups against nested dataclasses.

    An option may be null if its type allows None. An option with a default may be missing; its default is
    then added to ``values``, unless ``partly`` is set.

    Args:
        options: a dataclass whose fields are made by :func:`option`.
        values: plain values by name.
        prefix: of the names on the command line, for instance ``model.``.
        partly: accept values that are missing, that refer to another option by ``${...}``, or that the
            dataclass does not have.

    Raises:
        InputError: an option is missing, unknown, of another type, or outside its bounds.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass
        ... class Options:
        ...     dropout: float = option(least=0, below=1, default=0.0)
        >>> values = {}
        >>> check_options(Options, values, "model.")
        >>> values
        {'dropout': 0.0}
        >>> check_options(Options, {"dropout": 1.5}, "model.")
        Traceback (most recent call last):
            ...
        rcnn_odom.errors.InputError: model.dropout=1.5: must be a number from 0 and below 1
    """
    known = {option_field.name: option_field for option_field in fields(options)}
    types_of = typing.get_type_hints(options)
    for name in set() if partly else values.keys() - known.keys():
        raise InputError(f"{prefix}{name}: there is no such option; there are {', '.join(sorted(known))}")
    for name, option_field in known.items():
        if name not in values:
            if not partly and option_field.default is MISSING:
                raise InputError(
                    f"{prefix}{name} is missing; the settings may be those of an older version: train again"
                )
            if not partly:
                values[name] = option_field.default
        elif isinstance(values[name], dict) or not (partly and "${" in str(values[name])):
            _check_value(f"{prefix}{name}", values[name], types_of[name], option_field.metadata, partly)


def _check_value(name: str, value: Any, kind: Any, bounds: Any, partly: bool) -> None:
    """Checks one value against its type ``kind`` and its bounds.

    Raises:
        InputError: the value, or one in its group, is not allowed.
    """
    if is_dataclass(kind):
        if not isinstance(value, dict):
            first = next(iter(fields(kind))).name
            raise InputError(f"{name}={value}: is a group; set its members, for instance {name}.{first}=...")
        check_options(kind, value, f"{name}.", partly=partly)  # type: ignore[arg-type]
        return
    is_union = typing.get_origin(kind) in (types.UnionType, typing.Union)
    allowed = typing.get_args(kind) if is_union else (kind,)
    if value is None and type(None) in allowed:
        return
    if not (_has_allowed_type(value, allowed) and _is_within_bounds(value, bounds)):
        raise InputError(f"{name}={value}: {_describe_allowed(allowed, bounds)}")


def _has_allowed_type(value: Any, allowed: tuple[Any, ...]) -> bool:
    """Whether a value has one of the allowed types; a whole number is also a float, nan and inf are not."""
    kinds = {typing.get_origin(kind) or kind for kind in allowed}
    if isinstance(value, bool) or value is None:
        return bool in kinds and value is not None
    if isinstance(value, int) and float in kinds:
        return True
    return type(value) in kinds and (not isinstance(value, float) or math.isfinite(value))


def _is_within_bounds(value: Any, bounds: Any) -> bool:
    if isinstance(value, bool):
        return True
    return (
        (bounds.get("above") is None or value > bounds["above"])
        and (bounds.get("least") is None or value >= bounds["least"])
        and (bounds.get("below") is None or value < bounds["below"])
        and (not bounds.get("choices") or value in bounds["choices"])
        and (bounds.get("fits") is None or bounds["fits"](value))
    )


def _describe_allowed(allowed: tuple[Any, ...], bounds: Any) -> str:
    """Describes the allowed values of an option for an error message."""
    if bounds.get("wanted"):
        return f"must be {bounds['wanted']}"
    if bounds.get("choices"):
        return f"choose one of {', '.join(bounds['choices'])}"
    kinds = ["null" if kind is type(None) else TYPE_NAMES.get(kind, str(kind)) for kind in allowed]
    words = " or ".join(sorted(kinds, key="null".__ne__))
    limits = [
        f"{text} {bounds[key]:g}"
        for key, text in (("above", "above"), ("least", "from"), ("below", "below"))
        if bounds.get(key) is not None
    ]
    return f"must be {words} {' and '.join(limits)}".rstrip()
