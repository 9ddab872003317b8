"""What a scoring leaves behind: scores beside the baselines, trajectories, figures."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rcnn_odom.evaluation.figures import coverage_figure, motion_figure, trajectory_figure
from rcnn_odom.evaluation.metrics import Report
from rcnn_odom.evaluation.run_folder import Settings
from rcnn_odom.evaluation.scores import (
    coverage,
    coverage_table,
    in_deviations,
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
SIDEWAYS = 1e-5
"""Metres to the side from which on a step says more than two numbers: above a network's rounding."""


def report_drives(
    name: str,
    steps: Mapping[str, Steps],
    mean_step: FloatArray | None,
    latency: Report,
    drives: list[Drive],
    data: Settings,
    folder: Path,
    add_figure: Callable[[str, "Figure"], None] | None = None,
) -> Report:
    """Scores a model's estimates beside the baselines; writes trajectories and figures.

    Args:
        name: of the model.
        steps: what it makes of the drives, by their name.
        mean_step: (3,) of the training drives, which the baseline ``mean_motion`` repeats; None where it
            is not known.
        latency: the model's time, see :func:`rcnn_odom.evaluation.latency.measure`.
        drives: with their truth.
        data: the options of ``conf/data``.
        folder: gets ``trajectories`` and ``figures``.
        add_figure: also gets each figure, and its name.

    Returns:
        ``test`` (see :func:`rcnn_odom.evaluation.scores.score_all`); ``baselines`` of the same form by name,
        among them ``NAME_two_numbers`` where the steps say more than two numbers can; ``latency``;
        ``path_ratio``, by drive the length of the estimated path over that of the true one (None where that
        stands still); ``versions`` of what computed them; and where covariances are known ``coverage`` by
        drive (see :func:`rcnn_odom.evaluation.scores.coverage`).
    """
    baselines = baseline_steps(mean_step, drives)
    methods = {name: steps, **baselines, **_in_two_numbers(name, steps, data["apply"])}
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


def _in_two_numbers(name: str, steps: Mapping[str, Steps], apply: Apply) -> dict[str, dict[str, Steps]]:
    """Steps cut to what two numbers can say, comparable with the floor; nothing where they say no more."""
    if max(_sideways(every.values, apply) for every in steps.values()) < SIDEWAYS:
        return {}
    cut = {
        drive: Steps.with_unknown_covariance(restate(every.values, apply)) for drive, every in steps.items()
    }
    return {f"{name}_two_numbers": cut}


def _sideways(steps: FloatArray, apply: Apply) -> float:
    """The farthest, in metres, that steps (N, 3) go beside the direction that their turn alone gives."""
    direction = steps_of(np.stack([np.ones(len(steps)), steps[:, 2]], axis=1), apply)
    return float(np.abs(direction[:, 0] * steps[:, 1] - direction[:, 1] * steps[:, 0]).max())


def baseline_steps(mean_step: FloatArray | None, drives: Sequence[Drive]) -> dict[str, dict[str, Steps]]:
    """What the baselines estimate, by their name and the drive's.

    Args:
        mean_step: (3,) that ``mean_motion`` repeats; without it that is left out.
        drives: to estimate; with ``wheel_odometry`` where all of them have it.
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
    """A drive's estimated trajectory in KITTI's and TUM's format, its truth, and the motions of all methods.

    Args:
        drive: with its truth.
        steps: estimated.
        baselines: motions (N-1, 2) of other methods by their names.
        folder: for the files.
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
    add_figure: Callable[[str, "Figure"], None] | None,
) -> None:
    """Figures by their names as files, and to whoever else wants them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures:
        figure.savefig(folder / f"{name}.png", dpi=120)
        if add_figure:
            add_figure(f"test/{name}", figure)


def _figures(
    name: str, steps: Mapping[str, Steps], drives: Sequence[Drive], data: str, test: Report
) -> Iterator[tuple[str, "Figure"]]:
    """The paper's two figures of each drive, and how the errors lie within their deviations."""
    for drive in drives:
        drift = percent(test["sequences"][drive.name]["drift"]["t_err"])
        title = f"{name} on {data} {drive.name}: drift {drift} %"
        estimate, file = steps[drive.name], file_name(drive.name)
        yield f"{file}_trajectory", trajectory_figure(title, drive.poses, estimate.poses())
        yield f"{file}_motion", motion_figure(title, drive.motions, motions_of(estimate.values))
    ratios = np.concatenate([in_deviations(steps[drive.name], drive.steps)[0] for drive in drives])
    if len(ratios):
        names = ", ".join(drive.name for drive in drives)
        title = f"{name} on {data} {names}: errors within their estimated deviations"
        yield "coverage", coverage_figure(title, ratios)
