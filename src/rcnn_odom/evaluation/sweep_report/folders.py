"""Finds and reads the run folders below a folder, and determines how each run ended."""

import os
import re
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import yaml

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.metrics import BUILT_IN, Report, combine
from rcnn_odom.evaluation.run_folder import (
    CONFIG,
    ERROR,
    METRICS,
    Settings,
    flat,
    has_finished,
    read_metrics_file,
    read_settings,
    stopped_by,
)

Scores = dict[str, Any]
"""The scores of one run or method by name; None for a score that is not known."""

OVERRIDES_FILE, HYDRA_FILE = ".hydra/overrides.yaml", ".hydra/hydra.yaml"


@dataclass(frozen=True)
class Metrics:
    """The content of a ``metrics.json``; all attributes are empty for a run that has not finished.

    Attributes:
        variant: name of the model.
        data: name of the data.
        is_training: whether a training wrote the file; otherwise ``evaluate.py`` did.
        sequences: names of the test sequences.
        by_length: for each segment length in metres, the number of segments, their mean translation error (a
            ratio) and their mean rotation error (degrees per metre).
        scores: see :func:`_method_scores`; in addition ``val_drift`` (a ratio), ``latency_ms``, ``seconds``
            of training and ``same_as``. Values that an older run did not store are None.
        baselines: the scores of each baseline by its name.
        versions: versions of the packages by name.
    """

    variant: str = ""
    data: str = ""
    is_training: bool = False
    sequences: tuple[str, ...] = ()
    by_length: dict[float, tuple[int, float, float]] = field(default_factory=dict)
    scores: Scores = field(default_factory=dict)
    baselines: dict[str, Scores] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Run:
    """One run folder.

    Attributes:
        folder: path of the folder.
        name: its path relative to the folder that was searched.
        status: ``finished``, ``unfinished``, ``failed`` or ``damaged``.
        problem: one line that says why it is not finished; empty for a finished run.
        settings: its resolved configuration with dotted names and lists as tuples; empty if the
            configuration cannot be read.
        overrides: the options that its command set.
        metrics: the content of its ``metrics.json``; empty unless the run is finished.
    """

    folder: Path
    name: str
    status: str
    problem: str
    settings: Settings
    overrides: tuple[str, ...]
    metrics: Metrics = field(default_factory=Metrics)

    @property
    def is_evaluation(self) -> bool:
        """Whether it is a finished scoring by ``evaluate.py``, without a training of its own."""
        return self.status == "finished" and not self.metrics.is_training


def find_runs(directory: Path) -> list[Run]:
    """Finds all run folders below a folder, sorted by :func:`natural_order` of their names.

    Links (``latest``) are not followed. The ``first_stage`` of a run belongs to that run. An evaluation that
    did not finish is left out.

    Raises:
        InputError: there is no such folder, or it is the folder of a single run.
    """
    if not directory.is_dir():
        raise InputError(
            f"{directory}: no such folder; name the folder of a sweep, outputs/multirun/..., or outputs"
        )
    if _is_run(directory):
        raise InputError(
            f"{directory}: this is the folder of one run; name a folder that contains several runs"
        )
    found = []
    for path, subfolders, _ in os.walk(directory):
        folder = Path(path)
        if folder != directory and _is_run(folder) and not (folder / CONFIG).is_symlink():
            subfolders.clear()
            evaluates = read_hydra_value(folder / HYDRA_FILE, "hydra", "job", "name") == "evaluate"
            if (folder / METRICS).exists() or not evaluates:
                found.append(read_run(folder, folder.relative_to(directory).as_posix()))
    return sorted(found, key=lambda run: natural_order(run.name))


def natural_order(text: str) -> list[tuple[int, int, str]]:
    """A sort key that compares numbers in a text by value, so that ``run 9`` comes before ``run 10``.

    Example:
        >>> sorted(["run 10", "run 9"], key=natural_order)
        ['run 9', 'run 10']
    """
    parts = re.findall(r"[0-9]+|[^0-9]+", text)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def _is_run(folder: Path) -> bool:
    return any((folder / name).exists() for name in (CONFIG, METRICS, ERROR, OVERRIDES_FILE))


def read_hydra_value(path: Path, *keys: str) -> Any:
    """Reads a value from a YAML file that Hydra wrote; None if the file or the value is missing.

    Args:
        path: path of the file.
        keys: keys of the nested dictionaries that lead to the value.
    """
    with suppress(OSError, yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError):
        return reduce(getitem, keys, yaml.safe_load(path.read_text(encoding="utf-8")))
    return None


def read_run(folder: Path, name: str) -> Run:
    """Reads a run from its folder. A damaged run raises nothing: ``status`` and ``problem`` describe it."""
    overrides = read_hydra_value(folder / OVERRIDES_FILE)
    overrides = tuple(map(str, overrides)) if isinstance(overrides, list) else ()
    run = Run(folder, name, "unfinished", "", {}, overrides)
    finished = has_finished(folder)
    if (folder / CONFIG).exists():
        try:
            settings = flat(read_settings(folder, ("data", "model")))
        except InputError:
            return replace(run, status="damaged", problem=f"{CONFIG} cannot be read")
        tuples = {name: tuple(value) for name, value in settings.items() if isinstance(value, list)}
        run = replace(run, settings=settings | tuples)
    if finished:
        run = _read_finished(run)
    if run.settings and "seed" not in run.settings and not run.is_evaluation:
        return replace(run, status="damaged", problem=f"{CONFIG} has no seed", settings={})
    if finished:
        return run
    if (folder / ERROR).exists():
        problem = " ".join((folder / ERROR).read_text(encoding="utf-8", errors="replace").split())
        return replace(run, status="failed", problem=problem or f"{ERROR} is empty")
    if reason := stopped_by(folder):
        return replace(run, problem=f"stopped by {reason}; the same command continues it")
    ended = "stopped, or still running" if run.settings else f"ended before its {CONFIG} was written"
    return replace(run, problem=f"no {METRICS}: {ended}")


def _read_finished(run: Run) -> Run:
    """Adds the metrics to a run that has finished; the result is damaged if they cannot be read."""
    if not run.settings:
        return replace(run, status="damaged", problem=f"{CONFIG} is missing")
    try:
        metrics = _read_metrics(read_metrics_file(run.folder))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ZeroDivisionError) as error:
        what = f"{METRICS} cannot be read, or is incomplete"
        return replace(run, status="damaged", problem=f"{what} ({type(error).__name__}: {error})")
    return replace(run, status="finished", metrics=metrics)


def _read_metrics(content: Report) -> Metrics:
    """Converts the content of a ``metrics.json``.

    Raises:
        KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError: the content has another form.
    """
    test, latency, training = content["test"], content.get("latency") or {}, content.get("training") or {}
    others = {
        "val_drift": _number((content.get("val") or {}).get("drift")),
        "latency_ms": _number(latency.get("median_ms")),
        "seconds": _number(training.get("seconds")),
        "same_as": content.get("same_as"),
    }
    return Metrics(
        str(content["variant"]),
        str(content["data"]),
        "seed" in content,
        tuple(test["sequences"]),
        {length: _length_errors(test, f"{length:g}") for length in map(float, test["lengths"])},
        _method_scores(test) | others,
        {name: _method_scores(report) for name, report in content.get("baselines", {}).items()},
        {name: str(version) for name, version in (content.get("versions") or {}).items()},
    )


def _length_errors(test: Report, length: str) -> tuple[int, float, float]:
    """Errors over the segments of one length of all sequences.

    Args:
        test: ``test`` of a ``metrics.json``.
        length: the length in metres as a key of ``per_length``.

    Returns:
        Number of segments, mean translation error (a ratio) and mean rotation error (degrees per metre).
    """
    drifts = [one["drift"].get("per_length", {}).get(length) for one in test["sequences"].values()]
    parts = [part for part in drifts if part]
    segments = sum(part["segments"] for part in parts)
    t_err, r_err = (
        sum(part["segments"] * part[key] for part in parts) / max(segments, 1)
        for key in ("t_err", "r_err_deg_per_m")
    )
    return segments, t_err, r_err


def _method_scores(report: Report) -> Scores:
    """All metrics of a method over its test sequences, and its drift on each sequence.

    Args:
        report: ``test`` of a ``metrics.json``, or one of its ``baselines``. A report of an older version has
            no ``metrics``; they are then computed from its sequences.

    Returns:
        The metrics in their stored units; ``floor``; and ``drift_NAME`` and ``floor_NAME`` of each sequence
        as ratios, None if no segment was long enough.

    Raises:
        KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError: the report has another form.
    """
    sequences = report["sequences"]
    metrics = report["metrics"] if "metrics" in report else combine(sequences.values(), BUILT_IN)
    scores = {name: _number(value) for name, value in metrics.items()}
    for kind in ("drift", "floor"):
        scores[kind] = _number(report[kind])
        scores |= {f"{kind}_{name}": _number(one[kind]["t_err"]) for name, one in sequences.items()}
    return scores


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def first_stage_seconds(run: Run) -> float | None:
    """Training time of the first stage in seconds; None if the run did not train a first stage itself."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        return float(read_metrics_file(run.folder / "first_stage")["training"]["seconds"])
    return None
