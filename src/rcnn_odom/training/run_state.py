"""Run folders: what is in them, and how one is found again."""

import hashlib
import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from rcnn_odom.errors import InputError
from rcnn_odom.files import held
from rcnn_odom.training.settings import Settings

if TYPE_CHECKING:  # torch would make --help slow
    from rcnn_odom.training.datamodule import OdometryDataModule

log = logging.getLogger(__name__)

RECIPE_VERSION = 3
"""Raised whenever the same settings train another network, so that an older first stage is not taken."""

CONFIG, METRICS = "config.yaml", "metrics.json"
RUNNING = ".running.lock"
"""Held while a run is trained."""
BEST, LAST = "checkpoints/best.ckpt", "checkpoints/last.ckpt"


def start_run(run: Path, settings: Settings) -> None:
    """Makes a run's folder with its resolved configuration, or enters one that was stopped.

    Raises:
        InputError: the folder holds a finished run or one with other settings, or cannot be written.
    """
    config = run / CONFIG
    if (run / METRICS).exists():
        raise InputError(f"{run}: holds a finished run; choose another run_dir")
    if config.exists() and not _same(read_settings(run), settings):
        raise InputError(
            f"{config}: the run was begun with other settings; repeat them, or choose another run_dir"
        )
    try:
        write_config(run, settings)
    except OSError as error:
        raise InputError(f"{run}: cannot be written ({error.strerror}); choose another run_dir") from error
    log.info("run %s, seed %d", run, settings["seed"])


@contextmanager
def claimed(run: Path) -> Iterator[None]:
    """Makes a run's folder where missing, and keeps other processes away from it while it is trained.

    Raises:
        InputError: another process trains it, or the folder cannot be made.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{run}: cannot be made ({error.strerror}); choose another run_dir") from error
    with held(run / RUNNING) as mine:
        if not mine:
            raise InputError(f"{run}: another process is training this run; wait, or choose another run_dir")
        yield


def find_stopped(folder: Path, settings: Settings) -> Path | None:
    """The newest run in a folder that was begun with these settings, is not finished, and runs no more."""
    runs = [config.parent for config in folder.glob(f"*/{CONFIG}")]
    for run in sorted(runs, key=lambda run: (run / CONFIG).stat().st_mtime, reverse=True):
        with suppress(InputError, OSError):  # of a stranger's folder
            if (run / METRICS).exists() or not _same(read_settings(run), settings):
                continue
            with held(run / RUNNING) as stopped:
                if stopped:
                    return run
    return None


def finished(run: Path, settings: Settings) -> dict[str, Any] | None:
    """What the ``metrics.json`` of a run holds if it was finished with these settings."""
    try:
        metrics: dict[str, Any] = json.loads((run / METRICS).read_text())
        return metrics if _same(read_settings(run), settings) else None
    except (OSError, ValueError, InputError):
        return None


def _same(first: Settings, second: Settings) -> bool:
    """Whether two configurations are of one run, wherever its folder now is."""
    elsewhere = {"run_dir": None, "outputs": None}
    return first | elsewhere == second | elsewhere


def write_config(folder: Path, settings: Settings) -> None:
    """The settings into a folder, at once or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder / CONFIG, yaml.safe_dump(settings, sort_keys=False))


def point_latest(outputs: Path, run: Path) -> None:
    """Lets ``latest`` among the runs point to this one."""
    link = outputs / f".latest.{os.getpid()}"
    link.symlink_to(os.path.relpath(run.resolve(), outputs.resolve()))
    try:
        link.replace(outputs / "latest")
    finally:
        link.unlink(missing_ok=True)


def read_settings(run: Path) -> Settings:
    """The configuration that a run was started with.

    Raises:
        InputError: there is no run, or its configuration cannot be read.
    """
    try:
        settings = yaml.safe_load((run / CONFIG).read_text())
    except OSError as error:
        raise InputError(f"{run / CONFIG}: {error.strerror}; name a run's folder, run=outputs/...") from error
    except (yaml.YAMLError, UnicodeDecodeError):
        settings = None
    if not isinstance(settings, dict) or not {"data", "model", "trainer"} <= settings.keys():
        raise InputError(f"{run / CONFIG}: not the configuration of a run; name another, run=outputs/...")
    return settings


def fingerprint(settings: Settings, datamodule: "OdometryDataModule") -> str:
    """Hash of everything that decides what a training gives: recordings, network, recipe, seed."""
    from rcnn_odom.training.machine import resolve_precision  # with torch, which would make --help slow

    recordings = {
        split: [
            (sequence.key, sequence.name, hashlib.sha256(np.round(sequence.poses, 6).tobytes()).hexdigest())
            for sequence in datamodule.sequences[split]
        ]
        for split in ("train", "val")
    }
    data = {key: settings["data"][key] for key in ("augment", "lengths", "apply", "sensor")}
    if settings["data"].get("fresh_worlds"):  # drives that are not among the recordings yet
        data["fresh_worlds"] = settings["data"]["reader"]
    trainer = settings["trainer"]
    precision = resolve_precision(trainer["precision"], trainer["accelerator"])  # of the machine
    parts = [RECIPE_VERSION, recordings, data, settings["model"], trainer | {"precision": precision}]
    parts.append(settings["seed"])
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def find_run(outputs: Path, wanted: str) -> Path | None:
    """The best checkpoint of a finished run with this fingerprint, the newest if there are several."""
    found = []
    for metrics in outputs.rglob(METRICS):
        try:
            if json.loads(metrics.read_text())["fingerprint"] == wanted and (metrics.parent / BEST).exists():
                found.append(metrics)
        except (ValueError, KeyError, TypeError, OSError):
            continue  # not a finished run of ours
    newest = max(found, key=lambda path: path.stat().st_mtime, default=None)
    return newest.parent / BEST if newest else None


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes a JSON file at once or not at all."""
    _write(path, json.dumps(content, indent=2) + "\n")


def _write(path: Path, text: str) -> None:
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
