"""The benchmark job: measures one method on all sets, and writes the table of the sweep's methods so far."""

import json
import logging
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from rcnn_odom.evaluation.metrics import Report
from rcnn_odom.evaluation.run_folder import METRICS, Settings
from rcnn_odom.files import write_atomically
from rcnn_odom.options import check_options, option
from rcnn_odom.registry import choose
from rcnn_odom.training.benchmark.measure import one_core, run_timed, score_timed
from rcnn_odom.training.benchmark.methods import find_method
from rcnn_odom.training.benchmark.sets import load_sets
from rcnn_odom.training.benchmark.table import as_markdown, as_text
from rcnn_odom.training.job import in_sweep
from rcnn_odom.training.provenance import read_processor_name
from rcnn_odom.training.run_state import write_config, write_json
from rcnn_odom.training.settings import plain
from rcnn_odom.training.sweep import expected_folders

log = logging.getLogger(__name__)

TABLE = "benchmark"
"""Name of the files of the table, without ``.md`` and ``.json``."""
PACKAGES = ("rcnn-odom", "numpy", "numba", "kiss-icp", "genz-icp", "small_gicp", "karto-scanmatcher")


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """The options that all files of ``conf/benchmark`` have.

    Attributes:
        method: a model without training, a shipped network, a file of ``rcnn-odom export`` or a run.
        options: options of a model without training.
        root: folder of the recordings; sets whose recordings are missing are left out.
        lasers: lasers to which the sets refer.
        sets: the sets by name; see :class:`rcnn_odom.training.benchmark.sets.SetOptions`.
        only: names of the sets to measure; None: all.
        voxels: voxel sizes in metres by the name of a model and the kind of place.
    """

    method: str
    options: dict[str, Any]
    root: str
    lasers: dict[str, Any]
    sets: dict[str, Any] = option(fits=bool, wanted="sets of recordings by their names")  # noqa: RUF009
    only: list[Any] | None
    voxels: dict[str, Any]


def run_benchmark(cfg: DictConfig) -> Report:
    """Measures one method on all sets, and writes the table of the sweep's methods so far.

    Args:
        cfg: the configuration of ``evaluate.py`` with ``benchmark``.

    Returns:
        The content of the job's ``metrics.json``; ``benchmark`` has the scores by set, see
        :func:`rcnn_odom.training.benchmark.measure.score_timed`.

    Raises:
        InputError: an option is invalid, or there are no recordings.
    """
    settings = plain(cfg)
    options, folder = settings["benchmark"], Path(settings["run_dir"])
    check_options(BenchmarkOptions, options, "benchmark.")
    (folder / METRICS).unlink(missing_ok=True)  # Belongs to an earlier sweep.
    report: Report = {
        "method": options["method"],
        "options": options["options"],
        "benchmark": _measure(options),
        "machine": _machine(),
    }
    write_config(folder, {"benchmark": options, "outputs": settings["outputs"]})
    write_json(folder / METRICS, report)
    _write_table(folder)
    return report


def _measure(options: Settings) -> Report:
    """Measures the method; returns its scores by set."""
    names = options["only"] or list(options["sets"])
    sets = load_sets({name: choose("set of benchmark.sets", name, options["sets"]) for name in names})
    make_tracker = find_method(options["method"], options["options"], options["voxels"])
    scores = {}
    for name, loaded in sets.items():
        with one_core():
            tracker = make_tracker(loaded)
            timed = run_timed(tracker, loaded) if tracker else None
        if timed is None:
            log.info("%s: %s is of a laser that it was not trained for", options["method"], name)
            continue
        scores[name] = score_timed(timed, loaded)
        log.info("%s: %s done, %.2f ms a scan", options["method"], name, scores[name]["median_ms"])
    return scores


def _write_table(folder: Path) -> None:
    """Writes the table of the jobs so far; logs it after the last job."""
    folders, is_last = [folder], True
    if HydraConfig.initialized() and in_sweep():
        folder = Path(HydraConfig.get().sweep.dir)
        number, names = HydraConfig.get().job.num, expected_folders(folder) or []
        folders, is_last = [folder / name for name in names[: number + 1]], number + 1 == len(names)
    jobs = [
        json.loads(path.read_text("utf-8")) for path in (each / METRICS for each in folders) if path.exists()
    ]
    rows = {_row_name(job): job["benchmark"] for job in jobs}
    write_json(folder / f"{TABLE}.json", {"rows": rows, "machine": _machine()})
    write_atomically(folder / f"{TABLE}.md", as_markdown(rows, _machine()))
    if is_last:
        log.info("\n%s\n\nalso in %s", as_text(rows), folder / f"{TABLE}.md")


def _row_name(job: Report) -> str:
    """The name of a row: the method and the options that were set."""
    return " ".join([job["method"], *(f"{name}={value}" for name, value in job["options"].items())])


def _machine() -> dict[str, str]:
    """Properties of the machine that affect the times."""
    return {
        "processor": read_processor_name(),
        "threads": "1, bound to one core",
        "python": platform.python_version(),
        "packages": ", ".join(f"{package} {found}" for package in PACKAGES if (found := _version(package))),
    }


def _version(package: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
