"""A run's configuration as plain values, with the mistakes that Hydra cannot see found early."""

import math
from collections.abc import Callable
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcnn_odom.errors import InputError

Settings = dict[str, Any]
"""Plain numbers, strings, lists and dictionaries: what YAML, JSON and a checkpoint may hold."""

Rule = tuple[Callable[[Any], bool], str]


def _one_of(*choices: str) -> Rule:
    return lambda value: value in choices, f"choose one of {', '.join(choices)}"


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _is_count(value: Any) -> bool:
    return type(value) is int and value > 0


COUNT: Rule = (_is_count, "must be a whole number above 0")
POSITIVE: Rule = (lambda value: _is_number(value) and value > 0, "must be a number above 0")
FLAG: Rule = (lambda value: type(value) is bool, "must be true or false")
NAMES: Rule = (
    lambda value: isinstance(value, list) and 0 < len(value) == len(set(value)),
    "must list sequences, each once, for instance [a,b]",
)

RULES: dict[str, Rule] = {
    "pooling": _one_of("avg", "max"),
    "angle": _one_of("expectation", "argmax"),
    "apply": _one_of("start", "middle", "end"),
    "kernel_size": (lambda value: _is_count(value) and value % 2 == 1, "must be odd; the paper uses 3"),
    **dict.fromkeys(("count", "hidden_size", "layers", "epochs", "window", "batch_size"), COUNT),
    **dict.fromkeys(("beta", "learning_rate", "width_deg", "regression", "classification"), POSITIVE),
    **dict.fromkeys(("resolution_deg", "field_of_view_deg", "max_range"), POSITIVE),
    **dict.fromkeys(("freeze", "mirror", "per_sample_norm"), FLAG),
    **dict.fromkeys(("train", "val", "test"), NAMES),
    "max_turn_deg": (lambda value: _is_number(value) and value >= 0, "must be 0 or a positive number"),
    "workers": (lambda value: value is None or _is_count(value), "must be null or a whole number above 0"),
    "seed": (lambda value: type(value) is int and 0 <= value < 2**32, "must be a whole number, not negative"),
}
"""What the last part of an option's name asks of its value."""


def plain(cfg: DictConfig) -> Settings:
    """A configuration as plain values.

    Raises:
        InputError: a value that the user must give is missing, or one has no meaning.
    """
    for name, value in flat(OmegaConf.to_container(cfg)).items():  # type: ignore[arg-type]
        if value == "???":
            raise InputError(f"{name} is missing; give it on the command line, {name}=...")
    try:
        settings: Any = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise InputError(f"{error.full_key}: {str(error).splitlines()[0]}") from error
    data = settings.get("data") or {}
    for split in data.keys() & {"train", "val", "test"}:
        if isinstance(data[split], list):  # where [10] is a number to Hydra, and [00] is not
            data[split] = [str(name) for name in data[split]]
    for name, value in flat(settings).items():
        is_valid, wanted = RULES.get(name.split(".")[-1], (bool, ""))
        if wanted and not is_valid(value):
            raise InputError(f"{name}={value}: {wanted}")
    return settings


def flat(settings: Settings, prefix: str = "") -> Settings:
    """The settings under names as on the command line, ``model.kernel_size`` and so on."""
    pairs: Settings = {}
    for key, value in settings.items():
        pairs |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return pairs
