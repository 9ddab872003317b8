"""What is in a run's folder, and how it is read again; for those who train and for those who compare."""

import json
import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from rcnn_odom.errors import InputError

CONFIG, METRICS, ERROR = "config.yaml", "metrics.json", "error.txt"
BEST, LAST = "checkpoints/best.ckpt", "checkpoints/last.ckpt"
RUNNING = ".running.lock"
"""Held while a run is trained."""

Settings = dict[str, Any]
"""Plain numbers, strings, lists and dictionaries: what YAML, JSON and a checkpoint may hold."""


def flat(settings: Settings, prefix: str = "") -> Settings:
    """The settings under names as on the command line, ``model.kernel_size`` and so on."""
    pairs: Settings = {}
    for key, value in settings.items():
        pairs |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return pairs


def home_of(run: Path) -> Path:
    """The folder where a run really is: ``outputs/latest`` only holds links to what is in it."""
    return Path(os.path.relpath((run / CONFIG).resolve().parent)) if (run / CONFIG).is_symlink() else run


def find_weights(path: Path) -> Path:
    """The file of the best weights of a finished run; a path that is no folder as it is.

    ``outputs/latest`` shows a fine-tuning as soon as that has begun. Until it has finished, ``latest`` stands
    for the weights that it began with, so that the same command goes on with the same weights.

    Args:
        path: of a checkpoint, of a run's folder, or of ``outputs/latest``.

    Raises:
        InputError: the folder is none of a run, or of one that has not finished.
    """
    if not path.is_dir():
        return path
    run, settings = home_of(path), read_settings(path)
    if has_finished(run):
        return run / BEST
    begun_with = settings["model"].get("pretrained")
    if begun_with and (path / CONFIG).is_symlink():
        return Path(begun_with)
    raise InputError(f"{path}: a run that has not finished; let it finish, or give its {BEST}")


def read_settings(run: Path, groups: Collection[str] = ("data", "model", "trainer")) -> Settings:
    """The configuration that a run was started with.

    Args:
        run: its folder.
        groups: without which it is no configuration of a run.

    Raises:
        InputError: there is no run, or its configuration cannot be read.
    """
    try:
        settings = yaml.safe_load((run / CONFIG).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{run / CONFIG}: {error.strerror}; name a run's folder, run=outputs/...") from error
    except (yaml.YAMLError, UnicodeDecodeError):
        settings = None
    if not isinstance(settings, dict) or not all(isinstance(settings.get(group), dict) for group in groups):
        raise InputError(f"{run / CONFIG}: not the configuration of a run; name another, run=outputs/...")
    _upgrade(settings["data"], settings["model"])
    return settings


def _upgrade(data: Settings, model: Settings) -> None:
    """Brings a configuration of version 0.1 into today's form.

    There a recording's format was the full name of a function, and a model did not know where in a turn its
    distance is driven.
    """
    reader = data.get("reader")
    if isinstance(reader, dict) and "_target_" in reader:
        data["reader"] = {
            "format": str(reader.pop("_target_")).removesuffix(".load").split(".")[-1],
            **reader,
        }
        if "apply" in data:
            model.setdefault("apply", data["apply"])


def read_metrics_file(run: Path) -> dict[str, Any]:
    """What the ``metrics.json`` of a finished run holds.

    Raises:
        OSError: there is none.
        ValueError: it is damaged, or holds something that is no number.
    """
    content = json.loads((run / METRICS).read_text(encoding="utf-8"), parse_constant=_refuse)
    if not isinstance(content, dict):
        raise ValueError("holds no names")
    return content


def has_finished(run: Path) -> bool:
    """Whether a run has its scores and they are final: not those of a training that can go on."""
    return (run / METRICS).exists() and stopped_by(run) is None


def stopped_by(run: Path) -> str | None:
    """What ended a training before its last epoch, as its ``metrics.json`` says; None for others."""
    with suppress(OSError, ValueError, AttributeError):
        reason = (read_metrics_file(run).get("training") or {}).get("stopped_by")
        return None if reason is None else str(reason)
    return None


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not a score")
