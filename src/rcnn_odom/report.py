"""What a run leaves behind: scores beside the baselines, trajectories, figures, the HParams row."""

import logging
import re
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import lightning as L
import numpy as np
import numpy.typing as npt
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from rcnn_odom.baselines.constant import ConstantMotion, held_motion
from rcnn_odom.cache import EncodedSequence
from rcnn_odom.evaluation import Report, camera_trajectory, percent, score_all, table
from rcnn_odom.figures import motion_figure, trajectory_figure
from rcnn_odom.latency import measure
from rcnn_odom.modules import OdometryModule
from rcnn_odom.motion import FloatArray, compose, relative_motions
from rcnn_odom.networks import State
from rcnn_odom.settings import Settings, flat
from rcnn_odom.trajectory import write_kitti, write_motions, write_tum

log = logging.getLogger(__name__)

PACKAGES = ("torch", "lightning", "hydra-core", "torchmetrics", "numpy", "rcnn-odom")
LATENCY_FRAMES = 100
Motions = dict[str, FloatArray]
"""Estimated motions (N-1, 2) by the name of the sequence."""


def report_test(
    module: OdometryModule,
    motions: Motions,
    sequences: list[EncodedSequence],
    data: Settings,
    folder: Path,
    logger: TensorBoardLogger | None = None,
) -> Report:
    """Scores a network's estimates beside the baselines; writes trajectories and figures.

    Args:
        module: the network that estimated, which also knows the mean of its training motions.
        motions: its estimates.
        sequences: what was estimated.
        data: the options of ``conf/data``.
        folder: gets ``trajectories`` and ``figures``.
        logger: also gets the figures.

    Returns:
        ``test`` (see :func:`rcnn_odom.evaluation.score_all`), ``baselines`` of the same form by name,
        ``latency`` of the network (see :func:`rcnn_odom.latency.measure`) and ``versions`` of what computed
        them.
    """
    baselines = baseline_motions(module, sequences)
    reports = {
        method: score_all(sequences, estimated, data["lengths"], data["apply"])
        for method, estimated in {module.variant: motions, **baselines}.items()
    }
    log.info("\n%s\n", table(reports))
    test = reports.pop(module.variant)
    for sequence in sequences:
        drift = percent(test["sequences"][sequence.name]["drift"]["t_err"])
        title = f"{module.variant} on {data['name']} {sequence.name}: drift {drift} %"
        others = {method: estimated[sequence.name] for method, estimated in baselines.items()}
        write_sequence(sequence, motions[sequence.name], others, title, data, folder, logger)
    versions = {package: version(package) for package in PACKAGES}
    latency = measure(*stepping(module, sequences[0].scans))
    times = latency["median_ms"], latency["p99_ms"]
    log.info("%s: %.2f ms a frame, 99th percentile %.2f, on one thread", module.variant, *times)
    return {"test": test, "baselines": reports, "latency": latency, "versions": versions}


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


def baseline_motions(module: OdometryModule, sequences: list[EncodedSequence]) -> dict[str, Motions]:
    """What the baselines estimate, by their name; wheel odometry where every log has it."""
    mean = ConstantMotion(module.network.head.mean.double().cpu().numpy())
    baselines = {
        name: {sequence.name: baseline.estimate(sequence.scans) for sequence in sequences}
        for name, baseline in (("mean_motion", mean), ("held_motion", held_motion()))
    }
    wheels = {s.name: relative_motions(s.wheel_odometry) for s in sequences if s.wheel_odometry is not None}
    return baselines | ({"wheel_odometry": wheels} if len(wheels) == len(sequences) else {})


def write_sequence(
    sequence: EncodedSequence,
    motions: FloatArray,
    baselines: dict[str, FloatArray],
    title: str,
    data: Settings,
    folder: Path,
    logger: TensorBoardLogger | None,
) -> None:
    """One sequence's trajectory in KITTI and TUM format, its truth, motions, and the paper's two figures."""
    name = re.sub(r"[^\w.-]+", "_", sequence.name.replace(":", "-")).strip("_")
    for kind in ("trajectories", "figures"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    poses = camera_trajectory(sequence, motions, data["apply"])
    write_kitti(folder / "trajectories" / f"{name}.txt", poses)
    write_kitti(folder / "trajectories" / f"{name}_truth.txt", sequence.camera_poses)
    write_tum(folder / "trajectories" / f"{name}.tum", sequence.stamps, poses)
    write_motions(folder / "trajectories" / f"{name}_motions.csv", motions, sequence.motions, baselines)
    figures = {
        "trajectory": trajectory_figure(title, sequence.poses, compose(motions, data["apply"])),
        "motion": motion_figure(title, sequence.motions, motions),
    }
    for kind, figure in figures.items():
        figure.savefig(folder / "figures" / f"{name}_{kind}.png", dpi=120)
        if logger is not None:
            logger.experiment.add_figure(f"test/{name}_{kind}", figure)


def log_hyperparameters(trainer: L.Trainer, settings: Settings, metrics: Report) -> None:
    """The row of TensorBoard's HParams tab: every setting, and drift as its metric."""
    row = {name: str(value) if isinstance(value, list) else value for name, value in flat(settings).items()}
    # Under names of their own: as more points of val/drift they would purge that curve.
    scores = {"val/best_drift": metrics["val"]["drift"], "test/drift": metrics["test"]["drift"]}
    known = {name: value for name, value in scores.items() if value is not None}
    assert isinstance(trainer.logger, TensorBoardLogger)
    trainer.logger.log_hyperparams(row, known, trainer.global_step)
