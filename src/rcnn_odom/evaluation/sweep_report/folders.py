"""Run folders below a folder: which there are, and how each of them ended."""

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
"""Of one run or method; None for what is not known."""

OVERRIDES, HYDRA = ".hydra/overrides.yaml", ".hydra/hydra.yaml"


@dataclass(frozen=True)
class Metrics:
    """The content of a ``metrics.json``; everything is empty for a run that is not finished.

    Attributes:
        variant: name of the model.
        data: name of the data.
        is_training: whether a training wrote it, and not ``evaluate.py``.
        sequences: names of the test sequences.
        by_length: of each length of a segment in metres: how many segments, and their mean translation error
            (a ratio) and rotation error (degrees per metre).
        scores: see :func:`_method_scores`; beside them ``val_drift`` (a ratio), ``latency_ms``, ``seconds``
            of training and ``same_as``. What older runs do not say is None.
        baselines: scores of each, by its name.
        versions: of packages, by their names.
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
        folder: where it is.
        name: its path below the folder that was searched.
        status: ``finished``, ``unfinished``, ``failed`` or ``damaged``.
        problem: why it is not finished, one line; empty for a finished run.
        settings: its resolved configuration under dotted names, lists as tuples; empty where that cannot be
            read.
        overrides: what its command set.
        metrics: what its ``metrics.json`` holds; empty unless finished.
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
        """Scores without a training of its own, by ``evaluate.py``."""
        return self.status == "finished" and not self.metrics.is_training


def find_runs(directory: Path) -> list[Run]:
    """Every run folder below a folder, in the order of their names, numbers in order of their value.

    Links (``latest``) are not followed, and a run's own ``first_stage`` is a part of that run. An evaluation
    that did not finish is nothing.

    Raises:
        InputError: no such folder, or it is a run's own.
    """
    if not directory.is_dir():
        raise InputError(f"{directory}: no such folder; name a sweep's, outputs/multirun/... , or outputs")
    if _is_run(directory):
        raise InputError(f"{directory}: is the folder of one run; name the folder of several around it")
    found = []
    for path, subfolders, _ in os.walk(directory):
        folder = Path(path)
        if folder != directory and _is_run(folder) and not (folder / CONFIG).is_symlink():
            subfolders.clear()
            evaluates = hydras(folder / HYDRA, "hydra", "job", "name") == "evaluate"
            if (folder / METRICS).exists() or not evaluates:
                found.append(read_run(folder, folder.relative_to(directory).as_posix()))
    return sorted(found, key=lambda run: natural_order(run.name))


def natural_order(text: str) -> list[tuple[int, int, str]]:
    """A sort key by which ``run 9`` comes before ``run 10``."""
    parts = re.findall(r"[0-9]+|[^0-9]+", text)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def _is_run(folder: Path) -> bool:
    return any((folder / name).exists() for name in (CONFIG, METRICS, ERROR, OVERRIDES))


def hydras(path: Path, *keys: str) -> Any:
    """A part of a file that Hydra left; None where it is not there."""
    with suppress(OSError, yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError):
        return reduce(getitem, keys, yaml.safe_load(path.read_text(encoding="utf-8")))
    return None


def read_run(folder: Path, name: str) -> Run:
    """A run from its folder; nothing that is wrong with it raises, its status says it."""
    overrides = hydras(folder / OVERRIDES)
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
        return replace(run, problem=f"stopped by {reason}; the same command goes on")
    ended = "stopped, or still running" if run.settings else f"ended before its {CONFIG} was written"
    return replace(run, problem=f"no {METRICS}: {ended}")


def _read_finished(run: Run) -> Run:
    if not run.settings:
        return replace(run, status="damaged", problem=f"{CONFIG} is missing")
    try:
        metrics = _read_metrics(read_metrics_file(run.folder))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ZeroDivisionError) as error:
        what = f"{METRICS} cannot be read, or lacks what a finished run has"
        return replace(run, status="damaged", problem=f"{what} ({type(error).__name__}: {error})")
    return replace(run, status="finished", metrics=metrics)


def _read_metrics(content: Report) -> Metrics:
    """Raises KeyError, TypeError, ValueError, AttributeError or ZeroDivisionError for another form."""
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
        {length: _of_length(test, f"{length:g}") for length in map(float, test["lengths"])},
        _method_scores(test) | others,
        {name: _method_scores(report) for name, report in content.get("baselines", {}).items()},
        {name: str(version) for name, version in (content.get("versions") or {}).items()},
    )


def _of_length(test: Report, length: str) -> tuple[int, float, float]:
    """Number of segments, translation and rotation error, over the segments of all sequences."""
    drifts = [one["drift"].get("per_length", {}).get(length) for one in test["sequences"].values()]
    parts = [part for part in drifts if part]
    segments = sum(part["segments"] for part in parts)
    t_err, r_err = (
        sum(part["segments"] * part[key] for part in parts) / max(segments, 1)
        for key in ("t_err", "r_err_deg_per_m")
    )
    return segments, t_err, r_err


def _method_scores(report: Report) -> Scores:
    """Every metric of a method over its test sequences, and its drift by sequence.

    Args:
        report: ``test`` of a ``metrics.json``, or one of its ``baselines``; without ``metrics`` where an
            older version wrote it.

    Returns:
        The metrics in their stored units, ``floor``, and ``drift_NAME`` and ``floor_NAME`` of each sequence,
        ratios. None where no segment was long enough.

    Raises:
        KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError: the report is not of that form.
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
    """How long the first stage was trained, where that was done within the run."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        return float(read_metrics_file(run.folder / "first_stage")["training"]["seconds"])
    return None
