"""What a run is: new, stopped, finished, a twin of a finished one, or in another process' hands."""

import ast
import hashlib
import inspect
import json
import logging
import os
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from enum import Enum, auto
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

if TYPE_CHECKING:  # torch would make --help slow
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
"""Sources that decide what a training gives."""

LINKED = (
    *(CONFIG, METRICS, "train.log", "checkpoints", "trajectories", "figures"),
    *("model.onnx", "model_int8.onnx"),
)
"""What of a run is also seen in ``outputs/latest``: not its curves, which TensorBoard would show twice."""


ELSEWHERE = {"run_dir": None, "outputs": None}
"""Settings that say where a run is, not what it is."""


def _deciding(settings: Settings) -> Settings:
    """The settings that say what a run is, whatever time it was given."""
    trainer, model = settings["trainer"], _drop_unused(settings["model"])
    return settings | ELSEWHERE | {"trainer": trainer | dict.fromkeys(WITHOUT_EFFECT), "model": model}


def _drop_unused(model: Settings) -> Settings:
    """The options of a model without averaging where it is off, as in runs of versions that had none."""
    kept = {name: value for name, value in model.items() if name != "averaging" or value}
    if isinstance(model.get("first_stage"), dict):
        kept["first_stage"] = _drop_unused(model["first_stage"])
    return kept


class State(Enum):
    """What a run's folder holds."""

    NEW = auto()
    STOPPED = auto()  # begun with these settings and not finished, and no process trains it
    FINISHED = auto()
    TWIN = auto()  # not finished, but another run has finished the very same training
    LOCKED = auto()  # another process trains it
    OTHER = auto()  # a run with other settings, or on other recordings


class Fingerprints(NamedTuple):
    """Hashes of all that decides what a training gives.

    Attributes:
        settings: recordings, options, seed: whether a stopped run may go on from its checkpoint.
        code: whether, beside them, a finished run would come out the same today.
    """

    settings: str
    code: str


class Found(NamedTuple):
    """A run's state, and the folder that has the weights: of a twin not the run's own."""

    state: State
    run: Path


def state_of(
    run: Path, settings: Settings, wanted: Fingerprints | None = None, twins_in: Path | None = None
) -> Found:
    """What a run is; the only place that decides it.

    Args:
        run: its folder, which need not exist.
        settings: of the training that is wanted.
        wanted: its fingerprints, once its recordings are known.
        twins_in: where to look for a finished run with the same fingerprints; None: nowhere.

    Raises:
        InputError: the folder has a configuration that is none of a run.
    """
    begun = (run / CONFIG).exists()
    is_same = begun and _deciding(read_settings(run)) == _deciding(settings)
    if has_finished(run):
        metrics = _metrics_of(run) if is_same else {}
        finished = metrics and (wanted is None or metrics.get("fingerprint") == wanted.settings)
        return Found(State.FINISHED if finished else State.OTHER, run)
    if begun and not is_same:
        return Found(State.OTHER, run)
    if run.resolve() not in _claims and run.is_dir():
        with lock_if_free(run / RUNNING) as free:
            if not free:
                return Found(State.LOCKED, run)
    if twins_in and wanted and (twin := _find_twin(twins_in, wanted)):
        return Found(State.TWIN, twin)
    return Found(State.STOPPED if begun else State.NEW, run)


def _metrics_of(run: Path) -> dict[str, Any]:
    """What a run's ``metrics.json`` holds; nothing where that is damaged."""
    with suppress(OSError, ValueError):
        return read_metrics_file(run)
    return {}


def _find_twin(outputs: Path, wanted: Fingerprints) -> Path | None:
    """The newest finished run with these fingerprints."""
    for path in sorted(outputs.rglob(METRICS), key=lambda path: path.lstat().st_mtime, reverse=True):
        run = path.parent
        metrics = _metrics_of(run) if (run / BEST).exists() and stopped_by(run) is None else {}
        if not path.is_symlink() and (metrics.get("fingerprint"), metrics.get("code")) == wanted:
            return run
    return None


def find_stopped(folder: Path, settings: Settings) -> Path | None:
    """The newest stopped run with these settings in a folder; from here on it is this process' own."""
    runs = [config.parent for config in folder.glob(f"*/{CONFIG}")]
    for run in sorted(runs, key=lambda run: (run / CONFIG).stat().st_mtime, reverse=True):
        with suppress(InputError, OSError):  # of a stranger's folder
            # The second look is for what another process did between the first and the lock.
            if state_of(run, settings).state is State.STOPPED and _claim(run):
                if state_of(run, settings).state is State.STOPPED:
                    return run
                _release(run)
    return None


_claims: dict[Path, ExitStack] = {}
"""Locks of the runs that are this process' own, until it lets go of them or ends."""


def _claim(run: Path) -> bool:
    """Makes a run this process' own, unless another process has it."""
    with ExitStack() as stack:
        if run.resolve() not in _claims:
            if not stack.enter_context(lock_if_free(run / RUNNING)):
                return False
            _claims[run.resolve()] = stack.pop_all()
    return True


def _release(run: Path) -> None:
    _claims.pop(run.resolve()).close()


@contextmanager
def entered(run: Path, settings: Settings) -> Iterator[None]:
    """Makes a run's folder with its resolved configuration, or enters a stopped run.

    Other processes are kept away from it until the end.

    Raises:
        InputError: it is finished, has other settings, is trained by another process, or cannot be written.
    """
    if has_finished(run):
        raise InputError(f"{run}: holds a finished run; choose another run_dir")
    if state_of(run, settings).state is State.OTHER:
        raise InputError(
            f"{run / CONFIG}: the run was begun with other settings; repeat them, or choose another run_dir"
        )
    try:
        run.mkdir(parents=True, exist_ok=True)
        if not _claim(run):
            raise InputError(f"{run}: another process is training this run; wait, or choose another run_dir")
        if has_finished(run):  # by another process since the first look
            _release(run)
            raise InputError(f"{run}: holds a finished run; choose another run_dir")
        for left_over in (run / LAST).parent.glob(".*.partial"):  # of a process that was killed
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
    """Looks whether a stopped training may go on from what it saved; says so if the code changed since.

    Args:
        path: of the checkpoint ``saved``.
        wanted: fingerprints of the training that is to go on.

    Raises:
        InputError: the checkpoint belongs to another training.
    """
    if saved.get("fingerprint") != wanted.settings:
        raise InputError(
            f"{path}: saved by a training on other recordings or with another version of rcnn_odom; "
            "choose another run_dir, or remove it to begin again"
        )
    if saved.get("code") != wanted.code:
        log.info("the code has changed since this run began; what follows is trained by the new code")


def fingerprints(settings: Settings, datamodule: "OdometryDataModule") -> Fingerprints:
    """Those of a training whose recordings are loaded."""
    from rcnn_odom.models.contract import find_model  # with torch, which would make --help slow
    from rcnn_odom.recordings.formats import find_format

    # Models and formats may come from other packages.
    parts = find_model(settings["model"]["variant"]), find_format(settings["data"]["reader"]["format"])
    sources = [Path(source) for part in parts if (source := inspect.getsourcefile(part))]
    return Fingerprints(settings_fingerprint(settings, datamodule), code_fingerprint(PACKAGE, sources))


def settings_fingerprint(settings: Settings, datamodule: "OdometryDataModule") -> str:
    """Hash of a training's recordings, options and seed."""
    from rcnn_odom.training.machine import resolve_precision  # with torch, which would make --help slow

    recordings = {
        split: [
            (drive.key, drive.name, hashlib.sha256(np.round(drive.poses, 6).tobytes()).hexdigest())
            for drive in datamodule.drives[split]
        ]
        for split in ("train", "val")
    }
    data = {key: settings["data"][key] for key in ("augment", "lengths", "apply", "sensor")}
    if settings["data"].get("fresh_worlds"):  # drives that are not among the recordings yet
        data["fresh_worlds"] = settings["data"]["reader"]
    trainer = {name: value for name, value in settings["trainer"].items() if name not in WITHOUT_EFFECT}
    precision = resolve_precision(trainer["precision"], trainer["accelerator"])  # of the machine
    model = _name_weights(_drop_unused(settings["model"]))
    parts = [recordings, data, model, trainer | {"precision": precision}, settings["seed"]]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def _name_weights(model: Settings) -> Settings:
    """The options of a model with the hash of the weights that it begins with, in place of their file."""
    from rcnn_odom.training.checkpoint import weights_fingerprint  # with torch, which would make --help slow

    named = {name: value for name, value in model.items() if name != "pretrained"}
    if model.get("pretrained"):
        named["pretrained"] = weights_fingerprint(model["pretrained"])
    if model.get("first_stage"):
        named["first_stage"] = _name_weights(model["first_stage"])
    return named


def code_fingerprint(package: Path, others: Iterable[Path] = ()) -> str:
    """Hash of the statements that decide a training: comments, docstrings and layout do not count.

    Args:
        package: the folder of ``rcnn_odom``.
        others: source files outside of it; those inside count once.
    """
    inside = {path for pattern in DECIDING for path in package.glob(pattern)}
    return hash_statements([*sorted(inside), *sorted(set(others) - inside)])


def hash_statements(sources: Iterable[Path]) -> str:
    """Hash of the statements in source files, in this order."""
    statements = hashlib.sha256()
    for path in sources:
        tree = ast.parse(path.read_bytes())
        for node in ast.walk(tree):
            body = getattr(node, "body", None)
            if isinstance(body, list):  # a constant that stands alone does nothing
                node.body = [one for one in body if not _is_constant(one)]  # type: ignore[attr-defined]
        statements.update(f"{path.name}: {ast.dump(tree)}\n".encode())
    return statements.hexdigest()[:16]


def _is_constant(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def write_config(folder: Path, settings: Settings) -> None:
    """The settings into a folder, at once or not at all."""
    write_atomically(folder / CONFIG, yaml.safe_dump(settings, sort_keys=False))


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes a JSON file at once or not at all."""
    write_atomically(path, json.dumps(content, indent=2) + "\n")


def point_latest(outputs: Path, run: Path) -> None:
    """Lets ``latest`` among the runs show this one: a folder of links, also to what is not there yet."""
    latest = outputs / "latest"
    # One process at a time, so that it never shows parts of two runs.
    with one_at_a_time(outputs / "cache", "latest", "pointing outputs/latest to its run"):
        if latest.is_symlink():  # as earlier versions left it
            latest.unlink()
        latest.mkdir(exist_ok=True)
        for name in LINKED:
            link = latest / f".{name}.link"
            link.unlink(missing_ok=True)
            link.symlink_to(os.path.relpath(run.resolve() / name, latest.resolve()))
            link.replace(latest / name)
