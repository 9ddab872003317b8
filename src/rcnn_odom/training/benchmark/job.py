"""One method on all sets, and the table of a sweep's methods so far."""

import json
import logging
import platform
import re
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
from rcnn_odom.training.run_state import write_config, write_json
from rcnn_odom.training.settings import plain
from rcnn_odom.training.sweep import expected_folders

log = logging.getLogger(__name__)

TABLE = "benchmark"
"""Name of the table's files, ``.md`` and ``.json``."""
PACKAGES = ("rcnn-odom", "numpy", "numba", "kiss-icp", "genz-icp", "small_gicp", "karto-scanmatcher")


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """What the files of ``conf/benchmark`` have in common.

    Attributes:
        method: a model that does not train, a shipped network, a file of ``rcnn-odom export`` or a run.
        options: of a model that does not train.
        root: folder of the recordings; what is not there is left out.
        lasers: for the sets to refer to.
        sets: by their names; see :class:`rcnn_odom.training.benchmark.sets.SetOptions`.
        only: names of the sets that are measured; None: all.
        voxels: metres by the name of a model and the kind of place.
    """

    method: str
    options: dict[str, Any]
    root: str
    lasers: dict[str, Any]
    sets: dict[str, Any] = option(fits=bool, wanted="sets of recordings by their names")  # noqa: RUF009
    only: list[Any] | None
    voxels: dict[str, Any]


def run_benchmark(cfg: DictConfig) -> Report:
    """Measures one method on all sets; in a sweep also writes the table of the methods so far.

    Args:
        cfg: the configuration of ``evaluate.py`` with ``benchmark``.

    Returns:
        What the job's ``metrics.json`` holds: ``benchmark``, see
        :func:`rcnn_odom.training.benchmark.measure.score_timed`, by set.

    Raises:
        InputError: see its message.
    """
    settings = plain(cfg)
    options, folder = settings["benchmark"], Path(settings["run_dir"])
    check_options(BenchmarkOptions, options, "benchmark.")
    (folder / METRICS).unlink(missing_ok=True)  # of an earlier sweep, which is not compared with this one
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
    """Scores of the method by set."""
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
    """Writes the table of the jobs up to this one; prints it after the last."""
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
    """A method, and the options that it was given beside its own."""
    return " ".join([job["method"], *(f"{name}={value}" for name, value in job["options"].items())])


def _machine() -> dict[str, str]:
    """What the times depend on."""
    return {
        "processor": _processor(),
        "threads": "1, bound to one core",
        "python": platform.python_version(),
        "packages": ", ".join(f"{package} {found}" for package in PACKAGES if (found := _version(package))),
    }


def _processor() -> str:
    """Its name as the system tells it."""
    info = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.*)", info.read_text("utf-8")) if info.exists() else None
    features = "AVX-512" if info.exists() and "avx512f" in info.read_text("utf-8") else ""
    return " ".join(filter(None, [found[1] if found else platform.processor(), features]))


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
