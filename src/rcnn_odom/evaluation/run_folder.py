"""The files of a run's folder and functions that read them, for training and for reports."""

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
"""Lock that the training process holds."""

Settings = dict[str, Any]
"""Plain numbers, strings, lists and dictionaries, which YAML, JSON and checkpoints can store."""


def flat(settings: Settings, prefix: str = "") -> Settings:
    """Flattens nested settings to dotted names as on the command line.

    Example:
        >>> flat({"seed": 0, "model": {"kernel_size": 3}})
        {'seed': 0, 'model.kernel_size': 3}
    """
    pairs: Settings = {}
    for key, value in settings.items():
        pairs |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return pairs


def home_of(run: Path) -> Path:
    """The real folder of a run; ``outputs/latest`` contains only links to the files of that folder."""
    return Path(os.path.relpath((run / CONFIG).resolve().parent)) if (run / CONFIG).is_symlink() else run


def find_weights(path: Path) -> Path:
    """Finds the checkpoint with the best weights of a finished run.

    ``outputs/latest`` points to a fine-tuning as soon as the fine-tuning has started. Until it has finished,
    ``latest`` means the weights that it started from, so that repeating an interrupted command continues
    with the same weights.

    Args:
        path: a run's folder or ``outputs/latest``; a path that is not a folder, such as a checkpoint, is
            returned unchanged.

    Raises:
        InputError: the folder is not a run's folder, or the run has not finished.
    """
    if not path.is_dir():
        return path
    run, settings = home_of(path), read_settings(path)
    if has_finished(run):
        return run / BEST
    pretrained = settings["model"].get("pretrained")
    if pretrained and (path / CONFIG).is_symlink():
        return Path(pretrained)
    raise InputError(f"{path}: this run has not finished; let it finish, or give its {BEST}")


def read_settings(run: Path, groups: Collection[str] = ("data", "model", "trainer")) -> Settings:
    """Reads the configuration that a run was started with.

    Args:
        run: the run's folder.
        groups: groups of options that the configuration must have.

    Raises:
        InputError: there is no configuration, or it cannot be read or lacks a group.
    """
    try:
        settings = yaml.safe_load((run / CONFIG).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{run / CONFIG}: {error.strerror}; name a run's folder, run=outputs/...") from error
    except (yaml.YAMLError, UnicodeDecodeError):
        settings = None
    if not isinstance(settings, dict) or not all(isinstance(settings.get(group), dict) for group in groups):
        raise InputError(f"{run / CONFIG}: not the configuration of a run; name another, run=outputs/...")
    _upgrade_settings(settings["data"], settings["model"])
    return settings


def _upgrade_settings(data: Settings, model: Settings) -> None:
    """Converts a configuration of version 0.1 to the present form, in place.

    In version 0.1 the format of a recording was the full name of a function, and ``apply``, the place in the
    turn where a step is applied, was an option of the data only, not of the model.
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
    """Reads the ``metrics.json`` of a finished run.

    Raises:
        OSError: the file does not exist or cannot be read.
        ValueError: the file is damaged, or contains nan or infinity.
    """
    content = json.loads((run / METRICS).read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    if not isinstance(content, dict):
        raise ValueError("the content is not a JSON object")
    return content


def has_finished(run: Path) -> bool:
    """Whether a run has final scores: false while its training can still be continued."""
    return (run / METRICS).exists() and stopped_by(run) is None


def stopped_by(run: Path) -> str | None:
    """Why a training ended before its last epoch, from its ``metrics.json``; None if it did not."""
    with suppress(OSError, ValueError, AttributeError):
        reason = (read_metrics_file(run).get("training") or {}).get("stopped_by")
        return None if reason is None else str(reason)
    return None


def _refuse_constant(constant: str) -> None:
    raise ValueError(f"{constant} is not a score")
