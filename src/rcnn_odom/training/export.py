"""The steps of ``rcnn-odom export``: calibrate, convert, compare, score and write."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.metrics import Report
from rcnn_odom.evaluation.run_folder import Settings, read_settings
from rcnn_odom.evaluation.scores import coverage, coverage_table, score_all, table
from rcnn_odom.geometry import Steps
from rcnn_odom.models.contract import Stepper
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.models.pairs import PairTracker, estimate_encoded
from rcnn_odom.models.trained import TrainedModel
from rcnn_odom.recordings.parts import parse_part
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.training.checkpoint import load_module
from rcnn_odom.training.onnx_graph import compare_with_model, to_onnx, write, write_metadata
from rcnn_odom.training.stages import build_datamodule

if TYPE_CHECKING:
    import onnx

MAX_ADDED_DRIFT = 0.001
"""Largest drift, as a ratio, that the exported file may add to that of the checkpoint."""


def export_checkpoint(
    checkpoint: Path, run: Path, out: Path, precision: str, fit_on: list[str] | None = None
) -> None:
    """Writes an ONNX file of a run's checkpoint and prints the drift of each precision.

    Args:
        checkpoint: the checkpoint to export; it is not changed.
        run: folder of the run, whose configuration names the test sequences.
        out: the file to write.
        precision: ``fp32`` or ``int8``.
        fit_on: drives to fit the uncertainty on. None: the uncertainty of the checkpoint is used; if it has
            none, as in a stopped training, it is fitted on the validation sequences.

    Raises:
        InputError: there is no such checkpoint or configuration; recordings are missing; the network was
            trained or is tested on a drive of ``fit_on``; the graph differs from the checkpoint or has too
            much more drift.
    """
    model, settings = load_module(checkpoint).model, read_settings(run)
    data = settings["data"]
    if fit_on:
        _refuse_used_drives(fit_on, data)
        data["val"] = fit_on
    fit = bool(fit_on) or not model.calibrated
    datamodule = build_datamodule(settings).load(("val", "test") if fit else ("test",))
    if fit:
        model.calibrate(datamodule.drives["val"])
    drives = datamodule.drives["test"]
    steppers, graphs = _convert(model, dict.fromkeys(("fp32", precision)))
    offline = {drive.name: model.estimate(drive) for drive in drives}
    reports = _score(offline, steppers, drives, data)
    print(table(reports), flush=True)
    covered = {drive.name: coverage(offline[drive.name], drive.steps) for drive in drives}
    known = {name: report for name, report in covered.items() if report is not None}
    if known:
        print(f"\n{coverage_table(known)}\n", flush=True)
    _check_added_drift(reports, precision)
    report = reports[f"onnx {precision}"]
    each = {name: one["drift"]["t_err"] for name, one in report["sequences"].items()}
    drift = {"data": data["name"], "mean": report["drift"], "sequences": each}  # ratios
    write_metadata(graphs[precision], steppers[precision].metadata | {"drift": drift})
    _write(graphs[precision], out, checkpoint)


def export_unscored(checkpoint: Path, out: Path, precision: str) -> None:
    """Writes an ONNX file without recordings; it is compared with the checkpoint on random scans only.

    Args:
        checkpoint: the checkpoint to export.
        out: the file to write.
        precision: ``fp32`` or ``int8``.

    Raises:
        InputError: there is no such checkpoint, or the graph differs from it.
    """
    _, graphs = _convert(load_module(checkpoint).model, [precision])
    _write(graphs[precision], out, checkpoint)


def load_odometer(checkpoint: str | Path, threads: int = 1) -> Odometer:
    """Builds an odometer with the network of a checkpoint, which is exported in memory.

    Args:
        checkpoint: a ``.ckpt`` file of a run.
        threads: number of threads of the network.

    Raises:
        InputError: there is no such checkpoint.
    """
    graph = to_onnx(load_module(checkpoint).model, "fp32")
    return Odometer(PairTracker(OnnxStepper(graph.SerializeToString(), threads)))


def _refuse_used_drives(names: list[str], data: Settings) -> None:
    """Refuses drives of the training or test. Training on NAME includes its new worlds, ``NAME~1`` etc.

    The validation drives may be parts of recordings that were trained on.
    """
    others = [name for name in names if name not in data["val"]]
    used, wanted = (
        {parse_part(name).file.split("~")[0] for name in each}
        for each in (data["train"] + data["test"], others)
    )
    if used_drives := sorted(used & wanted):
        raise InputError(f"--fit-on: {', '.join(used_drives)} was trained or is tested on; name other drives")


def _convert(
    model: TrainedModel, precisions: Iterable[str]
) -> tuple[dict[str, OnnxStepper], dict[str, "onnx.ModelProto"]]:
    """Converts a model to graphs and compares them with it; returns steppers and graphs by precision."""
    graphs = {precision: to_onnx(model, precision) for precision in precisions}
    steppers = {each: OnnxStepper(graph.SerializeToString()) for each, graph in graphs.items()}
    for stepper in steppers.values():
        compare_with_model(stepper, model)
    return steppers, graphs


def _write(graph: "onnx.ModelProto", out: Path, checkpoint: Path) -> None:
    """Writes a graph and prints its size."""
    write(graph, out)
    size = out.stat().st_size / 1e6
    print(f"{out}: {size:.1f} MB, its steps compared with those of {checkpoint}")


def _score(
    offline: dict[str, Steps], steppers: dict[str, OnnxStepper], drives: list[Drive], data: Settings
) -> dict[str, Report]:
    """Scores the checkpoint and each precision, see :func:`rcnn_odom.evaluation.scores.score_all`."""
    estimates = {"checkpoint": offline}
    for precision, stepper in steppers.items():
        estimates[f"onnx {precision}"] = {drive.name: stream_steps(stepper, drive) for drive in drives}
    return {
        method: score_all(drives, steps, data["lengths"], data["apply"])
        for method, steps in estimates.items()
    }


def stream_steps(stepper: Stepper, drive: Drive) -> Steps:
    """Estimates the steps of a drive, one scan after the other."""
    stepper.reset()
    frames = tqdm(range(len(drive)), desc=drive.name, unit="scan", disable=None, leave=False)
    return estimate_encoded(stepper, (np.array(drive.scans[frame]) for frame in frames))


def _check_added_drift(reports: dict[str, Report], precision: str) -> None:
    """Refuses a precision with too much more drift than the checkpoint."""
    exact, exported = reports["checkpoint"]["drift"], reports[f"onnx {precision}"]["drift"]
    if exact is None:
        raise InputError("no test sequence has a segment, so there is no drift to compare; use --no-drift")
    if not exported - exact <= MAX_ADDED_DRIFT:  # Also refuses nan.
        advice = "train longer" if precision == "fp32" else "leave out --quantize"
        raise InputError(
            f"{precision} adds {100 * (exported - exact):.2f} percentage points of drift, more than "
            f"{100 * MAX_ADDED_DRIFT:g}, and is not written; {advice}"
        )
