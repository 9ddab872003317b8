"""The report of a run: scores of the model and of the baselines, trajectory files and figures."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rcnn_odom.evaluation.figures import coverage_figure, draw_pixels, motion_figure, trajectory_figure
from rcnn_odom.evaluation.metrics import Report
from rcnn_odom.evaluation.run_folder import Settings
from rcnn_odom.evaluation.scores import (
    coverage,
    coverage_table,
    errors_in_deviations,
    metrics_table,
    path_ratio,
    percent,
    score_all,
    table,
)
from rcnn_odom.geometry import FloatArray, Steps, change_frame, motions_of, relative_steps
from rcnn_odom.models.constant import ConstantStep, held_motion
from rcnn_odom.models.two_numbers import Apply, restate, steps_of
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.trajectory import file_name, write_kitti, write_motions, write_tum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

PACKAGES = ("torch", "lightning", "hydra-core", "torchmetrics", "numpy", "scipy", "numba", "rcnn-odom")
LATERAL_TOLERANCE = 1e-5
"""Largest lateral deviation in metres that counts as rounding; beyond it a step contains more than distance
and heading change."""


def report_drives(
    name: str,
    steps: Mapping[str, Steps],
    mean_step: FloatArray | None,
    latency: Report,
    drives: list[Drive],
    data: Settings,
    folder: Path,
    add_figure: Callable[[str, npt.NDArray[np.uint8]], None] | None = None,
) -> Report:
    """Scores the estimates of a model and of the baselines; writes trajectories and figures.

    Args:
        name: name of the model.
        steps: the model's steps by the name of the drive.
        mean_step: (3,) mean step of the training drives, which the baseline ``mean_motion`` repeats; None if
            it is unknown.
        latency: computing time of the model, see :func:`rcnn_odom.evaluation.latency.measure`.
        drives: drives with ground truth.
        data: the options of ``conf/data``.
        folder: folder in which ``trajectories`` and ``figures`` are written.
        add_figure: also called with the name of each figure and its pixels, (height, width, 3).

    Returns:
        ``test`` (see :func:`rcnn_odom.evaluation.scores.score_all`); ``baselines``, the same by the name of
        the baseline, with ``NAME_two_numbers`` among them if the steps contain more than distance and
        heading change; ``latency``; ``path_ratio`` by drive, the estimated path length divided by the true
        one (None if the true one is 0); ``versions`` of the packages that were used; and, if covariances are
        known, ``coverage`` by drive (see :func:`rcnn_odom.evaluation.scores.coverage`).
    """
    baselines = baseline_steps(mean_step, drives)
    methods = {name: steps, **baselines, **_reduce_steps(name, steps, data["apply"])}
    reports = {
        method: score_all(drives, estimated, data["lengths"], data["apply"])
        for method, estimated in methods.items()
    }
    log.info("\n%s\n\n%s\n", table(reports), metrics_table(reports))
    times = latency["median_ms"], latency["p99_ms"]
    log.info("%s: %.2f ms a frame, 99th percentile %.2f, on one thread", name, *times)
    test = reports.pop(name)
    shares = {drive.name: share for drive in drives if (share := coverage(steps[drive.name], drive.steps))}
    for drive in drives:
        others = {method: motions_of(every[drive.name].values) for method, every in baselines.items()}
        write_drive(drive, steps[drive.name], others, folder / "trajectories")
    _save_figures(_figures(name, steps, drives, data["name"], test), folder / "figures", add_figure)
    versions = {package: version(package) for package in PACKAGES}
    paths = {drive.name: path_ratio(steps[drive.name], drive) for drive in drives}
    report = {
        "test": test,
        "baselines": reports,
        "latency": latency,
        "path_ratio": paths,
        "versions": versions,
    }
    if shares:
        log.info("%s\n", coverage_table(shares))
        report["coverage"] = shares
    return report


def _reduce_steps(name: str, steps: Mapping[str, Steps], apply: Apply) -> dict[str, dict[str, Steps]]:
    """The steps reduced to distance and heading change, which can be compared with the floor.

    Args:
        name: name of the model.
        steps: its steps by the name of the drive.
        apply: where along the turn a distance is driven.

    Returns:
        The reduced steps by drive under ``NAME_two_numbers``; empty if the steps contain nothing else.
    """
    if max(_lateral_deviation(every.values, apply) for every in steps.values()) < LATERAL_TOLERANCE:
        return {}
    reduced = {
        drive: Steps.with_unknown_covariance(restate(every.values, apply)) for drive, every in steps.items()
    }
    return {f"{name}_two_numbers": reduced}


def _lateral_deviation(steps: FloatArray, apply: Apply) -> float:
    """Largest lateral deviation in metres of steps (N, 3) from the direction that their turns alone give."""
    direction = steps_of(np.stack([np.ones(len(steps)), steps[:, 2]], axis=1), apply)
    return float(np.abs(direction[:, 0] * steps[:, 1] - direction[:, 1] * steps[:, 0]).max())


def baseline_steps(mean_step: FloatArray | None, drives: Sequence[Drive]) -> dict[str, dict[str, Steps]]:
    """Steps of the baselines, by the name of the baseline and then of the drive.

    Args:
        mean_step: (3,) step that the baseline ``mean_motion`` repeats; None leaves this baseline out.
        drives: drives to estimate. If all of them have wheel odometry, it is the baseline
            ``wheel_odometry``.
    """
    constant = {"mean_motion": ConstantStep(mean_step)} if mean_step is not None else {}
    baselines = {
        method: {drive.name: baseline.estimate(drive) for drive in drives}
        for method, baseline in (constant | {"held_motion": held_motion()}).items()
    }
    wheels = {drive.name: drive.wheel_odometry for drive in drives}
    known = {drive: relative_steps(poses) for drive, poses in wheels.items() if poses is not None}
    if len(known) == len(drives):
        baselines["wheel_odometry"] = {
            drive: Steps.with_unknown_covariance(values) for drive, values in known.items()
        }
    return baselines


def write_drive(drive: Drive, steps: Steps, baselines: Mapping[str, FloatArray], folder: Path) -> None:
    """Writes a drive's estimated and true trajectory, and the motions of all methods.

    The estimate is written in KITTI's and in TUM's format, the truth in KITTI's, the motions as CSV.

    Args:
        drive: a drive with ground truth.
        steps: the estimated steps.
        baselines: motions (N-1, 2) of the other methods by name.
        folder: folder of the files; it is created if missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    name = file_name(drive.name)
    camera_poses = change_frame(steps.poses(), drive.camera_from_laser)
    write_kitti(folder / f"{name}.txt", camera_poses)
    write_kitti(folder / f"{name}_truth.txt", drive.camera_poses)
    write_tum(folder / f"{name}.tum", drive.stamps, camera_poses)
    write_motions(folder / f"{name}_motions.csv", motions_of(steps.values), drive.motions, baselines)


def _save_figures(
    figures: Iterable[tuple[str, "Figure"]],
    folder: Path,
    add_figure: Callable[[str, npt.NDArray[np.uint8]], None] | None,
) -> None:
    """Saves each figure under its name as a PNG file, and passes its pixels to ``add_figure``."""
    from matplotlib.image import imsave

    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures:
        pixels = draw_pixels(figure)
        imsave(folder / f"{name}.png", pixels)
        if add_figure:
            add_figure(f"test/{name}", pixels)


def _figures(
    name: str, steps: Mapping[str, Steps], drives: Sequence[Drive], data: str, test: Report
) -> Iterator[tuple[str, "Figure"]]:
    """The two figures of the paper for each drive, and the figure of the coverage if deviations are known."""
    for drive in drives:
        drift = percent(test["sequences"][drive.name]["drift"]["t_err"])
        title = f"{name} on {data} {drive.name}: drift {drift} %"
        estimate, file = steps[drive.name], file_name(drive.name)
        yield f"{file}_trajectory", trajectory_figure(title, drive.poses, estimate.poses())
        yield f"{file}_motion", motion_figure(title, drive.motions, motions_of(estimate.values))
    ratios = np.concatenate([errors_in_deviations(steps[drive.name], drive.steps)[0] for drive in drives])
    if len(ratios):
        names = ", ".join(drive.name for drive in drives)
        title = f"{name} on {data} {names}: errors within their estimated deviations"
        yield "coverage", coverage_figure(title, ratios)
