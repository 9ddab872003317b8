"""The state of a run: new, stopped, finished, the same as a finished one, or locked by another process."""

import ast
import hashlib
import inspect
import json
import logging
import os
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from enum import Enum, auto
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import yaml

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import (
    BEST,
    CONFIG,
    LAST,
    METRICS,
    RUNNING,
    has_finished,
    read_metrics_file,
    read_settings,
    stopped_by,
)
from rcnn_odom.files import lock_if_free, one_at_a_time, write_atomically
from rcnn_odom.training.settings import Settings
from rcnn_odom.training.trainer_options import WITHOUT_EFFECT

if TYPE_CHECKING:  # Importing torch would make --help slow.
    from rcnn_odom.training.datamodule import OdometryDataModule

log = logging.getLogger(__name__)

PACKAGE = Path(__file__).parents[1]
DECIDING = (
    "geometry.py",
    *("models/*.py", "recordings/**/*.py", "simulation/**/*.py"),
    *("training/modules.py", "training/datamodule.py", "training/windows.py", "training/augmentation.py"),
    "training/fresh_worlds.py",
    *("training/stages.py", "training/checkpoint.py", "training/saving.py", "training/machine.py"),
    *("training/pretrained.py", "training/matcher_truth.py", "training/averaging.py"),
    *("evaluation/drift.py", "evaluation/drift_metric.py"),
)
"""Sources that determine the result of a training."""

LINKED = (
    *(CONFIG, METRICS, "train.log", "checkpoints", "trajectories", "figures"),
    *("model.onnx", "model_int8.onnx"),
)
"""Files and folders of a run with a link in ``outputs/latest``; without the curves, which TensorBoard would
show twice."""


ELSEWHERE = {"run_dir": None, "outputs": None}
"""Settings for the place of a run, which do not change its result."""


def _deciding_settings(settings: Settings) -> Settings:
    """The settings with neutral values for those that do not change the result of a training."""
    trainer, model = settings["trainer"], _drop_unused(settings["model"])
    return settings | ELSEWHERE | {"trainer": trainer | dict.fromkeys(WITHOUT_EFFECT), "model": model}


def _drop_unused(model: Settings) -> Settings:
    """Removes ``averaging`` if it is off, as in runs of versions without that option."""
    kept = {name: value for name, value in model.items() if name != "averaging" or value}
    if isinstance(model.get("first_stage"), dict):
        kept["first_stage"] = _drop_unused(model["first_stage"])
    return kept


class State(Enum):
    """The state of a run's folder."""

    NEW = auto()
    STOPPED = auto()  # started with these settings, not finished, and no process trains it
    FINISHED = auto()
    TWIN = auto()  # not finished, but another run has finished exactly the same training
    LOCKED = auto()  # another process trains it
    OTHER = auto()  # a run with other settings, or on other recordings


class Fingerprints(NamedTuple):
    """Hashes of everything that determines the result of a training.

    Attributes:
        settings: hash of recordings, options and seed. A stopped run may continue if it is the same.
        code: hash of the source code. A finished run may be used in place of a new training if both are the
            same.
    """

    settings: str
    code: str


class Found(NamedTuple):
    """The state of a run, and the folder of its weights, or of a finished run with the same settings."""

    state: State
    run: Path


def state_of(
    run: Path, settings: Settings, wanted: Fingerprints | None = None, twins_in: Path | None = None
) -> Found:
    """Determines the state of a run.

    Args:
        run: folder of the run, which need not exist.
        settings: settings of the wanted training.
        wanted: fingerprints of the wanted training; None before its recordings are loaded.
        twins_in: folder to search for a finished run with the same fingerprints; None: no search.

    Raises:
        InputError: the configuration in the folder is not that of a run.
    """
    has_started = (run / CONFIG).exists()
    is_same = has_started and _deciding_settings(read_settings(run)) == _deciding_settings(settings)
    if has_finished(run):
        metrics = _read_metrics(run) if is_same else {}
        finished = metrics and (wanted is None or metrics.get("fingerprint") == wanted.settings)
        return Found(State.FINISHED if finished else State.OTHER, run)
    if has_started and not is_same:
        return Found(State.OTHER, run)
    if run.resolve() not in _claims and run.is_dir():
        with lock_if_free(run / RUNNING) as free:
            if not free:
                return Found(State.LOCKED, run)
    if twins_in and wanted and (twin := _find_twin(twins_in, wanted)):
        return Found(State.TWIN, twin)
    return Found(State.STOPPED if has_started else State.NEW, run)


def _read_metrics(run: Path) -> dict[str, Any]:
    """The content of a run's ``metrics.json``; an empty dictionary if it is missing or damaged."""
    with suppress(OSError, ValueError):
        return read_metrics_file(run)
    return {}


def _find_twin(outputs: Path, wanted: Fingerprints) -> Path | None:
    """The newest finished run with these fingerprints."""
    for path in sorted(outputs.rglob(METRICS), key=lambda path: path.lstat().st_mtime, reverse=True):
        run = path.parent
        metrics = _read_metrics(run) if (run / BEST).exists() and stopped_by(run) is None else {}
        if not path.is_symlink() and (metrics.get("fingerprint"), metrics.get("code")) == wanted:
            return run
    return None


def find_stopped(folder: Path, settings: Settings) -> Path | None:
    """Finds the newest stopped run with these settings in a folder, and locks it for this process."""
    runs = [config.parent for config in folder.glob(f"*/{CONFIG}")]
    for run in sorted(runs, key=lambda run: (run / CONFIG).stat().st_mtime, reverse=True):
        with suppress(InputError, OSError):  # A foreign folder can have any content.
            # Checked again after locking, since another process may have trained the run meanwhile.
            if state_of(run, settings).state is State.STOPPED and _claim(run):
                if state_of(run, settings).state is State.STOPPED:
                    return run
                _release(run)
    return None


_claims: dict[Path, ExitStack] = {}
"""Locks of runs that this process holds."""


def _claim(run: Path) -> bool:
    """Locks a run for this process; returns False if another process holds the lock."""
    with ExitStack() as stack:
        if run.resolve() not in _claims:
            if not stack.enter_context(lock_if_free(run / RUNNING)):
                return False
            _claims[run.resolve()] = stack.pop_all()
    return True


def _release(run: Path) -> None:
    """Releases the lock of a run."""
    _claims.pop(run.resolve()).close()


@contextmanager
def open_run(run: Path, settings: Settings) -> Iterator[None]:
    """Creates the folder of a run with its resolved configuration, or opens that of a stopped run.

    The run is locked against other processes until the context ends.

    Raises:
        InputError: the run is finished, has other settings, is trained by another process, or its folder
            cannot be written.
    """
    if has_finished(run):
        raise InputError(f"{run}: holds a finished run; choose another run_dir")
    if state_of(run, settings).state is State.OTHER:
        raise InputError(
            f"{run / CONFIG}: the run was started with other settings; repeat them, or choose another run_dir"
        )
    try:
        run.mkdir(parents=True, exist_ok=True)
        if not _claim(run):
            raise InputError(f"{run}: another process is training this run; wait, or choose another run_dir")
        if has_finished(run):  # Another process has finished it meanwhile.
            _release(run)
            raise InputError(f"{run}: holds a finished run; choose another run_dir")
        for left_over in (run / LAST).parent.glob(".*.partial"):  # Files of a process that was killed.
            left_over.unlink(missing_ok=True)
        write_config(run, settings)
    except OSError as error:
        raise InputError(f"{run}: cannot be written ({error.strerror}); choose another run_dir") from error
    log.info("run %s, seed %d", run, settings["seed"])
    try:
        yield
    finally:
        _release(run)


def check_checkpoint(path: Path, saved: dict[str, Any], wanted: Fingerprints) -> None:
    """Checks that a training may continue from a checkpoint; logs if the code has changed.

    Args:
        path: path of the checkpoint.
        saved: content of the checkpoint.
        wanted: fingerprints of the training.

    Raises:
        InputError: the checkpoint belongs to another training.
    """
    if saved.get("fingerprint") != wanted.settings:
        raise InputError(
            f"{path}: saved by a training on other recordings or with another version of rcnn_odom; "
            "choose another run_dir, or remove it to start again"
        )
    if saved.get("code") != wanted.code:
        log.info("the code has changed since this run was started; the remaining steps use the new code")


def fingerprints(settings: Settings, datamodule: "OdometryDataModule") -> Fingerprints:
    """The fingerprints of a training whose recordings are loaded."""
    from rcnn_odom.models.contract import find_model  # Imports torch, which would make --help slow.
    from rcnn_odom.recordings.formats import find_format

    # Models and formats can come from other packages.
    parts = find_model(settings["model"]["variant"]), find_format(settings["data"]["reader"]["format"])
    sources = [Path(source) for part in parts if (source := inspect.getsourcefile(part))]
    return Fingerprints(settings_fingerprint(settings, datamodule), code_fingerprint(PACKAGE, sources))


def settings_fingerprint(settings: Settings, datamodule: "OdometryDataModule") -> str:
    """Hash of a training's recordings, options and seed."""
    from rcnn_odom.training.machine import resolve_precision

    recordings = {
        split: [
            (drive.key, drive.name, hashlib.sha256(np.round(drive.poses, 6).tobytes()).hexdigest())
            for drive in datamodule.drives[split]
        ]
        for split in ("train", "val")
    }
    data = {key: settings["data"][key] for key in ("augment", "lengths", "apply", "sensor")}
    # With new worlds, later epochs have drives that are not among the recordings yet.
    if settings["data"].get("fresh_worlds"):
        data["fresh_worlds"] = settings["data"]["reader"]
    trainer = {name: value for name, value in settings["trainer"].items() if name not in WITHOUT_EFFECT}
    precision = resolve_precision(trainer["precision"], trainer["accelerator"])  # Depends on the machine.
    model = _replace_path_by_hash(_drop_unused(settings["model"]))
    parts = [recordings, data, model, trainer | {"precision": precision}, settings["seed"]]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def _replace_path_by_hash(model: Settings) -> Settings:
    """The options of a model, with a hash of the initial weights in place of the path ``pretrained``."""
    # Imports torch, which would make --help slow.
    from rcnn_odom.training.checkpoint import weights_fingerprint

    hashed = {name: value for name, value in model.items() if name != "pretrained"}
    if model.get("pretrained"):
        hashed["pretrained"] = weights_fingerprint(model["pretrained"])
    if model.get("first_stage"):
        hashed["first_stage"] = _replace_path_by_hash(model["first_stage"])
    return hashed


def code_fingerprint(package: Path, others: Iterable[Path] = ()) -> str:
    """Hash of the source code that determines a training, without comments, docstrings and layout.

    Args:
        package: the folder of ``rcnn_odom``.
        others: further source files; one that is already included counts once.
    """
    inside = {path for pattern in DECIDING for path in package.glob(pattern)}
    return hash_statements([*sorted(inside), *sorted(set(others) - inside)])


def hash_statements(sources: Iterable[Path]) -> str:
    """Hash of the statements in source files, in the given order."""
    statements = hashlib.sha256()
    for path in sources:
        statements.update(f"{path.name}: {_hash_source(path.read_bytes())}\n".encode())
    return statements.hexdigest()[:16]


@lru_cache(maxsize=1024)
def _hash_source(source: bytes) -> str:
    """Hash of the statements of a source file; cached, since parsing the package takes half a second."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):  # A constant alone, such as a docstring, has no effect.
            node.body = [one for one in body if not _is_constant(one)]  # type: ignore[attr-defined]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _is_constant(statement: ast.stmt) -> bool:
    """Whether a statement consists of a constant only."""
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def write_config(folder: Path, settings: Settings) -> None:
    """Writes the settings into a folder, completely or not at all."""
    write_atomically(folder / CONFIG, yaml.safe_dump(settings, sort_keys=False))


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes a JSON file completely or not at all."""
    write_atomically(path, json.dumps(content, indent=2) + "\n")


def link_latest(outputs: Path, run: Path) -> None:
    """Makes ``outputs/latest`` a folder of links to this run, also to files that do not exist yet."""
    latest = outputs / "latest"
    # One process at a time, so that the links never point to two runs.
    with one_at_a_time(outputs / "cache", "latest", "pointing outputs/latest to its run"):
        if latest.is_symlink():  # Earlier versions made a link.
            latest.unlink()
        latest.mkdir(exist_ok=True)
        for name in LINKED:
            link = latest / f".{name}.link"
            link.unlink(missing_ok=True)
            link.symlink_to(os.path.relpath(run.resolve() / name, latest.resolve()))
            link.replace(latest / name)
