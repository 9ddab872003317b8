"""Run folders below a folder: which there are, and how each of them ended."""

import json
import os
import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import yaml

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.sweep_report.scores import Metrics, read_metrics
from rcnn_odom.training.settings import Settings, flat

# By name and not from rcnn_odom.training.run_state, which brings all that a training needs.
CONFIG, METRICS, ERROR = "config.yaml", "metrics.json", "error.txt"
OVERRIDES, HYDRA = ".hydra/overrides.yaml", ".hydra/hydra.yaml"


@dataclass(frozen=True, eq=False)
class Run:
    """One run folder.

    Attributes:
        folder: where it is.
        name: its path below the folder that was searched.
        status: ``finished``, ``unfinished``, ``failed`` or ``damaged``.
        problem: why it is not finished, one line; empty for a finished run.
        settings: its resolved configuration under dotted names; empty where that cannot be read.
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
        if folder != directory and _is_run(folder):
            subfolders.clear()
            if (folder / METRICS).exists() or not _is_evaluation(folder):
                found.append(read_run(folder, folder.relative_to(directory).as_posix()))
    return sorted(found, key=lambda run: natural_order(run.name))


def natural_order(text: str) -> list[tuple[int, int, str]]:
    """A sort key by which ``run 9`` comes before ``run 10``."""
    parts = re.findall(r"[0-9]+|[^0-9]+", text)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def _is_run(folder: Path) -> bool:
    return any((folder / name).exists() for name in (CONFIG, METRICS, ERROR, OVERRIDES))


def _is_evaluation(folder: Path) -> bool:
    """Whether ``evaluate.py`` made a folder, by what Hydra left in it."""
    try:
        name: str = yaml.safe_load((folder / HYDRA).read_text())["hydra"]["job"]["name"]
    except (OSError, yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError):
        return False
    return name == "evaluate"


def read_run(folder: Path, name: str) -> Run:
    """A run from its folder; nothing that is wrong with it raises, its status tells."""
    run = Run(folder, name, "unfinished", "", {}, _read_overrides(folder))
    if (folder / CONFIG).exists():
        run = replace(run, settings=_read_settings(folder / CONFIG))
        if not run.settings:
            return replace(run, status="damaged", problem=f"{CONFIG} cannot be read")
    if (folder / METRICS).exists():
        run = _read_finished(run)
    if run.settings and "seed" not in run.settings and not run.is_evaluation:
        return replace(run, status="damaged", problem=f"{CONFIG} has no seed", settings={})
    if (folder / METRICS).exists():
        return run
    if (folder / ERROR).exists():
        return replace(run, status="failed", problem=_one_line(folder / ERROR))
    ended = "stopped, or still running" if run.settings else f"ended before its {CONFIG} was written"
    return replace(run, problem=f"no {METRICS}: {ended}")


def _read_settings(path: Path) -> Settings:
    """A configuration under dotted names; empty where it is not one of a run."""
    try:
        settings = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError, UnicodeDecodeError):
        return {}
    is_run = isinstance(settings, dict) and {"data", "model"} <= settings.keys()
    return flat(settings) if is_run else {}


def _read_finished(run: Run) -> Run:
    if not run.settings:
        return replace(run, status="damaged", problem=f"{CONFIG} is missing")
    try:
        metrics = read_metrics(json.loads((run.folder / METRICS).read_text(), parse_constant=_refuse))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ZeroDivisionError) as error:
        what = f"{METRICS} cannot be read, or lacks what a finished run has"
        return replace(run, status="damaged", problem=f"{what} ({type(error).__name__}: {error})")
    return replace(run, status="finished", metrics=metrics)


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not a score")


def _read_overrides(folder: Path) -> tuple[str, ...]:
    try:
        overrides = yaml.safe_load((folder / OVERRIDES).read_text())
    except (OSError, yaml.YAMLError, UnicodeDecodeError):
        return ()
    return tuple(map(str, overrides)) if isinstance(overrides, list) else ()


def _one_line(path: Path) -> str:
    try:
        return " ".join(path.read_text(errors="replace").split()) or f"{path.name} is empty"
    except OSError as error:
        return f"{path.name}: {error.strerror}"
