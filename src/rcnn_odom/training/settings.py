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


def _is_index(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**32


COUNT: Rule = (_is_count, "must be a whole number above 0")
POSITIVE: Rule = (lambda value: _is_number(value) and value > 0, "must be a number above 0")
FLAG: Rule = (lambda value: type(value) is bool, "must be true or false")
NAMES: Rule = (
    lambda value: isinstance(value, list) and 0 < len(value) == len(set(value)),
    "must list sequences, each once, for instance [a,b]",
)


def _group(part: str) -> Rule:
    """Of a name that only holds others: all of it at once would leave nothing to look its parts up in."""
    return lambda value: False, f"has parts to set, for instance {part}"


PATHS = ("root", "reference", "pretrained", "run", "run_dir", "outputs")
"""Options that may look like a number on the command line, ``data.root=2011``, and are a path."""

RULES: dict[str, Rule] = {
    "pooling": _one_of("avg", "max"),
    "angle": _one_of("expectation", "argmax"),
    "apply": _one_of("start", "middle", "end"),
    "kernel_size": (lambda value: _is_count(value) and value % 2 == 1, "must be odd; the paper uses 3"),
    **dict.fromkeys(
        ("count", "hidden_size", "layers", "epochs", "cnn", "rcnn", "window", "batch_size"), COUNT
    ),
    **dict.fromkeys(("beta", "learning_rate", "width_deg", "regression", "classification"), POSITIVE),
    **dict.fromkeys(("resolution_deg", "field_of_view_deg", "max_range"), POSITIVE),
    **dict.fromkeys(("freeze", "mirror", "per_sample_norm"), FLAG),
    **dict.fromkeys(("fresh_worlds", "keep_worlds", "vary_pace", "movers", "missing", "tilt"), FLAG),
    "world": _one_of("street", "indoor"),
    "scale": _one_of("small", "full"),
    **dict.fromkeys(("train", "val", "test"), NAMES),
    "lengths": (
        lambda value: isinstance(value, list) and bool(value) and all(map(POSITIVE[0], value)),
        "must list lengths in metres, for instance [1,2,5]",
    ),
    "precision": _one_of("auto", "bf16-mixed", "32-true"),
    "gradient_clip_val": (
        lambda value: value is None or POSITIVE[0](value),
        "must be null, which clips nothing, or a number above 0",
    ),
    "gradient_clip_algorithm": _one_of("norm"),
    **dict.fromkeys(("world_seed", "seed"), (_is_index, "must be a whole number, not negative")),
    "ring": (lambda value: value is None or _is_index(value), "must be null or a whole number, not negative"),
    "dropout": (lambda value: _is_number(value) and 0 <= value < 1, "must be a number from 0 to below 1"),
    "max_turn_deg": (lambda value: _is_number(value) and value >= 0, "must be 0 or a positive number"),
    **dict.fromkeys(
        ("workers", "frames", "projection"),
        (lambda value: value is None or _is_count(value), "must be null or a whole number above 0"),
    ),
    "sensor": _group("data.sensor.max_range=40"),
    "realism": _group("data.realism.tilt=false"),
    "passes": _group("data.passes.small.cnn=20"),
    "rotation_classes": _group("data.rotation_classes.count=56"),
    "augment": _group("data.augment.mirror=true"),
    "first_stage": _group("model.first_stage.epochs=20"),
}
"""What the last part of an option's name asks of its value."""


def plain(cfg: DictConfig) -> Settings:
    """A configuration as plain values.

    Raises:
        InputError: a value that the user must give is missing, or one has no meaning.
    """
    given = flat(OmegaConf.to_container(cfg))  # type: ignore[arg-type]
    for name, value in given.items():
        if value == "???":
            raise InputError(f"{name} is missing; give it on the command line, {name}=...")
    # Before others are looked up by it, where Hydra would name those and not the mistake.
    _check({name: value for name, value in given.items() if "${" not in str(value)})
    try:
        settings: Any = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise InputError(f"{error.full_key}: {str(error).splitlines()[0]}") from error
    data = settings.get("data") or {}
    for split in data.keys() & {"train", "val", "test"}:
        if isinstance(data[split], list):  # where [10] is a number to Hydra, and [00] is not
            data[split] = [str(name) for name in data[split]]
    _name_paths(settings)
    _check(flat(settings))
    return settings


def _check(values: Settings) -> None:
    for name, value in values.items():
        is_valid, wanted = RULES.get(name.split(".")[-1], (bool, ""))
        if wanted and not is_valid(value):
            raise InputError(f"{name}={value}: {wanted}")


def _name_paths(settings: Settings) -> None:
    for key, value in settings.items():
        if isinstance(value, dict):
            _name_paths(value)
        elif key in PATHS and value is not None:
            settings[key] = str(value)


def flat(settings: Settings, prefix: str = "") -> Settings:
    """The settings under names as on the command line, ``model.kernel_size`` and so on."""
    pairs: Settings = {}
    for key, value in settings.items():
        pairs |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return pairs
