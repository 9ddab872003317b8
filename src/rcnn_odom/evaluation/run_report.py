"""What a run leaves behind: scores beside the baselines, trajectories, figures."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from rcnn_odom.evaluation.figures import coverage_figure, motion_figure, trajectory_figure
from rcnn_odom.evaluation.latency import measure
from rcnn_odom.evaluation.scores import Report, coverage, coverage_table, percent, score_all, table
from rcnn_odom.geometry import FloatArray, change_frame, compose, motion_errors, relative_motions
from rcnn_odom.models.constant import ConstantMotion, held_motion
from rcnn_odom.models.icp import PointToLineICP, Steps
from rcnn_odom.models.networks import State
from rcnn_odom.recordings.cache import EncodedSequence
from rcnn_odom.recordings.trajectory import file_name, write_kitti, write_motions, write_tum
from rcnn_odom.training.modules import OdometryModule
from rcnn_odom.training.settings import Settings

log = logging.getLogger(__name__)

PACKAGES = ("torch", "lightning", "hydra-core", "torchmetrics", "numpy", "scipy", "numba", "rcnn-odom")
LATENCY_FRAMES = 100
Motions = Mapping[str, FloatArray]
"""Estimated motions (N-1, 2) by the name of the sequence."""


@dataclass(frozen=True)
class Estimates:
    """What one method makes of the sequences, by their name.

    Attributes:
        motions: (N-1, 2) metres and radians.
        poses: laser poses (N, 4, 4), the first the identity, of a method that also knows the steps' sideways
            part; they stand in place of the composed motions.
        deviations: standard deviations (N-1, 2) of the motions, of a method that gives them.
    """

    motions: Motions
    poses: Mapping[str, FloatArray] = field(default_factory=dict)
    deviations: Mapping[str, FloatArray] = field(default_factory=dict)

    @classmethod
    def of_poses(cls, poses: Mapping[str, FloatArray]) -> "Estimates":
        """Of a method that knows poses, wherever they start."""
        at_origin = {name: np.linalg.inv(every[0]) @ every for name, every in poses.items()}
        return cls({name: relative_motions(every) for name, every in poses.items()}, at_origin)


def report_test(
    module: OdometryModule,
    estimates: Estimates,
    sequences: list[EncodedSequence],
    data: Settings,
    folder: Path,
    logger: TensorBoardLogger | None = None,
) -> Report:
    """Scores a network's estimates beside the baselines; writes trajectories and figures.

    Args:
        module: the network that estimated, which also knows the mean of its training motions.
        estimates: what it makes of the sequences.
        sequences: what was estimated.
        data: the options of ``conf/data``.
        folder: gets ``trajectories`` and ``figures``.
        logger: also gets the figures.

    Returns:
        ``test`` (see :func:`rcnn_odom.evaluation.scores.score_all`), ``baselines`` of the same form by
        name, in ``coverage`` how often the truth lies within the deviations (see
        :func:`rcnn_odom.evaluation.scores.coverage`) by sequence where the network's uncertainty has been
        fitted, ``latency`` of the network (see :func:`rcnn_odom.evaluation.latency.measure`) and
        ``versions`` of what computed them.
    """
    mean = ConstantMotion(module.network.head.mean.double().cpu().numpy())
    latency = measure(*stepping(module, sequences[0].scans))
    report = _report(module.variant, estimates, mean, latency, sequences, data, folder, logger)
    return report | _report_coverage(module.variant, estimates, sequences, data, folder, logger)


def report_icp(
    icp: PointToLineICP,
    steps: Mapping[str, Steps],
    mean: ConstantMotion | None,
    sequences: list[EncodedSequence],
    data: Settings,
    folder: Path,
) -> Report:
    """The same as :func:`report_test` for scan matching, whose trajectories have all of its three numbers.

    Args:
        icp: the matcher, for its latency.
        steps: its estimates by the name of the sequence.
        mean: the baseline ``mean_motion``; None where not all training drives could be read.
        sequences, data, folder: as there.

    Returns:
        Also ``failures``: failed matches by the name of the sequence.
    """
    failures = {name: int(every.failed.sum()) for name, every in steps.items()}
    told = ", ".join(f"{failures[name]} of {len(every.failed)} on {name}" for name, every in steps.items())
    log.info(
        "icp: scans that do not overlap or leave a direction open, where the last motion goes on: %s", told
    )
    estimates = Estimates.of_poses({name: every.poses for name, every in steps.items()})
    latency = measure(*icp_stepping(icp, sequences[0].scans))
    return {**_report("icp", estimates, mean, latency, sequences, data, folder, None), "failures": failures}


def _report(
    name: str,
    estimates: Estimates,
    mean: ConstantMotion | None,
    latency: Report,
    sequences: list[EncodedSequence],
    data: Settings,
    folder: Path,
    logger: TensorBoardLogger | None,
) -> Report:
    """Scores, files and figures of one method beside the baselines."""
    baselines = baseline_estimates(mean, sequences)
    reports = {
        method: score_all(sequences, every.motions, data["lengths"], data["apply"], every.poses)
        for method, every in {name: estimates, **baselines}.items()
    }
    if estimates.poses:  # beside whole poses, what networks can say: comparable with them and with the floor
        reports[f"{name}_two_numbers"] = score_all(
            sequences, estimates.motions, data["lengths"], data["apply"]
        )
    log.info("\n%s\n", table(reports))
    test = reports.pop(name)
    for sequence in sequences:
        drift = percent(test["sequences"][sequence.name]["drift"]["t_err"])
        title = f"{name} on {data['name']} {sequence.name}: drift {drift} %"
        others = {method: every.motions[sequence.name] for method, every in baselines.items()}
        write_sequence(sequence, estimates, others, title, data, folder, logger)
    versions = {package: version(package) for package in PACKAGES}
    times = latency["median_ms"], latency["p99_ms"]
    log.info("%s: %.2f ms a frame, 99th percentile %.2f, on one thread", name, *times)
    return {"test": test, "baselines": reports, "latency": latency, "versions": versions}


def _report_coverage(
    name: str,
    estimates: Estimates,
    sequences: list[EncodedSequence],
    data: Settings,
    folder: Path,
    logger: TensorBoardLogger | None,
) -> Report:
    """``coverage`` by sequence with its table and figure; nothing where there are no deviations."""
    if not estimates.deviations:
        return {}
    cases = {s.name: (estimates.motions[s.name], s.motions, estimates.deviations[s.name]) for s in sequences}
    shares = {sequence: coverage(*case) for sequence, case in cases.items()}
    log.info("%s\n", coverage_table(shares))
    ratios = [np.abs(motion_errors(m, t)) / deviations for m, t, deviations in cases.values()]
    title = f"{name} on {data['name']} {', '.join(cases)}: errors within their estimated deviations"
    figure = coverage_figure(title, np.concatenate(ratios))
    figure.savefig(folder / "figures" / "coverage.png", dpi=120)
    if logger is not None:
        logger.experiment.add_figure("test/coverage", figure)
    return {"coverage": shares}


def stepping(module: OdometryModule, scans: npt.NDArray[np.float32]) -> tuple[Callable[[int], object], int]:
    """A network's estimate of one frame after the other, and how many frames to measure it on.

    Args:
        module: the network; a recurrent one carries its state from call to call.
        scans: depth vectors (N, bins) in metres.
    """
    device = next(module.parameters()).device
    tensor = torch.from_numpy(np.array(scans[: LATENCY_FRAMES + 1])).to(device)
    state: State | None = None

    def step(frame: int) -> object:
        nonlocal state
        with torch.no_grad():
            estimate, state = module.network(tensor[None, None, frame - 1 : frame + 1], state)
        return estimate.motion.cpu()

    return step, len(tensor) - 1


def icp_stepping(icp: PointToLineICP, scans: npt.NDArray[np.float32]) -> tuple[Callable[[int], object], int]:
    """The same as :func:`stepping` for scan matching, from a depth vector to a step."""
    scans = np.array(scans[: LATENCY_FRAMES + 1])
    earlier, guess = icp.outline(scans[0]), np.zeros(3)

    def step(frame: int) -> object:
        nonlocal earlier, guess
        if frame == 1:
            earlier, guess = icp.outline(scans[0]), np.zeros(3)
        later = icp.outline(scans[frame])
        match = icp.match(earlier, later, guess)
        earlier, guess = later, match.step
        return match

    return step, len(scans) - 1


def baseline_estimates(mean: ConstantMotion | None, sequences: list[EncodedSequence]) -> dict[str, Estimates]:
    """What the baselines estimate, by their name; wheel odometry where every log has it.

    Args:
        mean: the baseline ``mean_motion``, which is left out without one.
        sequences: to estimate.
    """
    constant = {"mean_motion": mean} if mean else {}
    constant["held_motion"] = held_motion()
    baselines = {
        name: Estimates({sequence.name: baseline.estimate(sequence.scans) for sequence in sequences})
        for name, baseline in constant.items()
    }
    wheels = {s.name: s.wheel_odometry for s in sequences if s.wheel_odometry is not None}
    return baselines | (
        {"wheel_odometry": Estimates.of_poses(wheels)} if len(wheels) == len(sequences) else {}
    )


def write_sequence(
    sequence: EncodedSequence,
    estimates: Estimates,
    baselines: dict[str, FloatArray],
    title: str,
    data: Settings,
    folder: Path,
    logger: TensorBoardLogger | None,
) -> None:
    """One sequence's trajectory in KITTI and TUM format, its truth, motions, and the paper's two figures."""
    name = file_name(sequence.name)
    for kind in ("trajectories", "figures"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    motions = estimates.motions[sequence.name]
    poses = estimates.poses.get(sequence.name, compose(motions, data["apply"]))
    camera_poses = change_frame(poses, sequence.camera_from_laser)
    write_kitti(folder / "trajectories" / f"{name}.txt", camera_poses)
    write_kitti(folder / "trajectories" / f"{name}_truth.txt", sequence.camera_poses)
    write_tum(folder / "trajectories" / f"{name}.tum", sequence.stamps, camera_poses)
    write_motions(folder / "trajectories" / f"{name}_motions.csv", motions, sequence.motions, baselines)
    figures = {
        "trajectory": trajectory_figure(title, sequence.poses, poses),
        "motion": motion_figure(title, sequence.motions, motions),
    }
    for kind, figure in figures.items():
        figure.savefig(folder / "figures" / f"{name}_{kind}.png", dpi=120)
        if logger is not None:
            logger.experiment.add_figure(f"test/{name}_{kind}", figure)
