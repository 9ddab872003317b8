"""Converts a run's configuration to plain values, and finds mistakes that Hydra does not find."""

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import Settings, find_weights, flat
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.options import check_options, option
from rcnn_odom.recordings.formats import find_format
from rcnn_odom.training.defaults import default
from rcnn_odom.training.overrides import PATHS
from rcnn_odom.training.trainer_options import (
    TrainerOptions,
    apply_fast_dev_run,
    check_devices,
    processes_per_node,
    refuse_names,
)

# For conf/model.
OmegaConf.register_new_resolver("default", default, replace=True)
# For conf/trainer.
OmegaConf.register_new_resolver("processes_per_node", processes_per_node, replace=True)

RENAMED = {
    "data.beta": "model.beta",
    "data.epochs": "model.epochs and model.first_stage.epochs",
    "data.passes": "model.epochs and model.first_stage.epochs",
    "data.rotation_classes": "model.rotation_classes",
    "model=icp": "model=matcher",
}
"""Options and choices of earlier versions, and their present names."""


def _names_option() -> Any:
    """An option whose value is a list of different names of sequences."""
    return option(
        fits=lambda names: 0 < len(names) == len(set(map(str, names))),
        wanted="a list of sequences, each once, for instance [a,b]",
    )


def _are_lengths(lengths: list[Any]) -> bool:
    """Whether these are lengths in metres."""
    return bool(lengths) and all(type(length) in (int, float) and 0 < length < 1e9 for length in lengths)


def _are_numbers(values: list[Any], count: int) -> bool:
    """Whether these are ``count`` numbers, none negative."""
    return len(values) == count and all(type(value) in (int, float) and 0 <= value < 1e9 for value in values)


@dataclass(kw_only=True)
class AugmentOptions:
    """``data.augment``; see :class:`rcnn_odom.training.augmentation.Augmentation`."""

    mirror: bool
    max_turn_deg: float = option(least=0, wanted="0 or a positive number")
    move: list[Any] | None = option(  # noqa: RUF009
        default=None,
        fits=lambda move: _are_numbers(move, 3),
        wanted="null or three deviations: metres ahead, to the left, and degrees, for instance [0.3,0.1,2]",
    )
    max_range_scale: float = option(default=1.0, least=1, below=100)
    lost_beams: float = option(default=0.0, least=0, below=1)
    lost_sector_deg: float = option(default=0.0, least=0, wanted="0 or a positive number")
    noise: float = option(default=0.0, least=0, wanted="0 or a positive number")
    beam_pattern: list[Any] | None = option(  # noqa: RUF009
        default=None,
        fits=lambda spacings: _are_numbers(spacings, 2) and 0 < spacings[0] <= spacings[1],
        wanted="null or the least and the largest spacing in degrees, for instance [0.05,0.3]",
    )


@dataclass(kw_only=True)
class DataOptions:
    """The options that all files of ``conf/data`` have."""

    reader: dict[str, Any] = option(  # noqa: RUF009
        fits=lambda reader: isinstance(reader.get("format"), str),
        wanted="the name of a format, data.reader.format, and the options of its load",
    )
    sensor: Sensor
    augment: AugmentOptions
    train: list[Any] | None = _names_option()  # noqa: RUF009
    val: list[Any] | None = _names_option()  # noqa: RUF009
    test: list[Any] = _names_option()  # noqa: RUF009
    lengths: list[Any] = option(  # noqa: RUF009
        fits=_are_lengths, wanted="a list of lengths in metres, for instance [1,2,5]"
    )
    apply: str = option(choices=("start", "middle", "end"))
    deskew: str = option(choices=("auto", "on", "off"))
    workers: int | None = option(above=0)


@dataclass(kw_only=True)
class Options:
    """The options that every run has, with any data and model."""

    trainer: TrainerOptions
    seed: int = option(least=0, below=2**32, wanted="a whole number, not negative")


def plain(cfg: DictConfig) -> Settings:
    """Converts a configuration to plain values and checks them.

    Raises:
        InputError: a required value is missing, or a value is not valid.
    """
    given: Any = OmegaConf.to_container(cfg)
    _convert_paths(given)
    _convert_deskew(given)
    for name, value in flat(given).items():
        if value == "???":
            raise InputError(f"{name} is missing; give it on the command line, {name}=...")
        if (group := ".".join(name.split(".")[:2])) in RENAMED:
            raise InputError(f"{group} has become {RENAMED[group]}; set that")
    # Checked before interpolations are resolved, since Hydra would not name the cause of an error there.
    _check_settings(given, complete=False)
    _check_data_names(given.get("data") or {})
    try:
        settings: Any = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise InputError(f"{error.full_key}: {str(error).splitlines()[0]}") from error
    data = settings.get("data") or {}
    for split in data.keys() & {"train", "val", "test"}:
        if isinstance(data[split], list):  # Hydra reads [10] as a number, and [00] as text.
            data[split] = [str(name) for name in data[split]]
    _convert_paths(settings)
    _replace_run_by_checkpoint(settings.get("model") or {})
    _convert_deskew(settings)
    _check_settings(settings, complete=True)
    _refuse_deskew(settings)
    if (settings.get("model") or {}).get("apply", data.get("apply")) != data.get("apply"):
        raise InputError(
            "model.apply must be the same as data.apply, which is also used for the floor; set data.apply"
        )
    apply_fast_dev_run(settings)
    check_devices(settings.get("trainer") or {})
    return settings


def _check_settings(settings: Settings, complete: bool) -> None:
    """Checks the settings against the options; if ``complete``, no option of the model may be missing."""
    data, model = settings.get("data") or {}, dict(settings.get("model") or {})
    check_options(Options, settings, "", partly=True)
    refuse_names(settings.get("trainer") or {})
    check_options(DataOptions, data, "data.", partly=True)
    for group, key in (("data", "reader"), ("model", "variant")):
        if complete and settings.get(group) and not settings[group].get(key):
            raise InputError(f"{group}.{key} is missing; a file of conf/{group} must have it")
    if name := data.get("reader", {}).get("format"):
        check_options(getattr(find_format(name), "Options", DataOptions), data, "data.", partly=True)
    if variant := str(model.pop("variant", "")):
        from rcnn_odom.models.contract import find_model  # Imports torch, which would make --help slow.

        check_options(find_model(variant).Options, model, "model.", partly=not complete)
        settings["model"] |= model  # Now with the defaults of options that were left out.


def _replace_run_by_checkpoint(model: Settings) -> None:
    """Replaces the folder of a run in ``pretrained`` by the path of its checkpoint.

    Raises:
        InputError: see :func:`rcnn_odom.evaluation.run_folder.find_weights`.
    """
    if model.get("pretrained"):
        model["pretrained"] = str(find_weights(Path(model["pretrained"])))
    if isinstance(model.get("first_stage"), dict):
        _replace_run_by_checkpoint(model["first_stage"])


def _convert_deskew(settings: Settings) -> None:
    """Converts ``deskew: on`` and ``off`` back to text; YAML reads them as true and false."""
    data = settings.get("data") or {}
    if isinstance(data.get("deskew"), bool):
        data["deskew"] = "on" if data["deskew"] else "off"


def _refuse_deskew(settings: Settings) -> None:
    """Refuses ``data.deskew=on`` for models that use depth vectors, which include all trained networks."""
    if (settings.get("data") or {}).get("deskew") != "on":
        return
    from rcnn_odom.models.contract import find_model  # Imports torch, which would make --help slow.

    variant = (settings.get("model") or {}).get("variant")
    if variant is None or getattr(find_model(variant), "uses_depth_vectors", True):
        raise InputError("data.deskew=on: networks use scans without deskewing; set data.deskew=auto")


def _check_data_names(data: Settings) -> None:
    """Refuses an option of the data that neither this project nor the format of the recordings uses.

    Args:
        data: the options before interpolations are resolved; ``data.reader`` refers to those of the format.
    """
    form = str(data.get("reader", {}).get("format"))
    if "${" in form or form == "None":
        return
    read = {each.name for each in fields(DataOptions)} | {"name", "fresh_worlds", "keep_worlds"}
    read |= {each.name for each in fields(getattr(find_format(form), "Options", DataOptions))}
    known = [name for name in data if name in read or re.search(rf"\$\{{[^}}]*\b{name}\b", str(data))]
    for name in data:
        if name not in known:
            raise InputError(f"data.{name}: there is no such option; there are {', '.join(sorted(known))}")


def _convert_paths(settings: Settings, prefix: str = "") -> None:
    """Converts the values of path options to text and replaces ``~`` by the user's home folder.

    Raises:
        InputError: a path is empty.
    """
    for key, value in settings.items():
        if isinstance(value, dict):
            _convert_paths(value, f"{prefix}{key}.")
        elif key in PATHS and value is not None:
            if not str(value).strip():
                raise InputError(f"{prefix}{key}= is an empty path; give one, or leave it out")
            settings[key] = str(value)
            if settings[key].startswith("~"):
                settings[key] = str(Path(value).expanduser())
