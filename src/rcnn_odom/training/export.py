"""The steps of ``rcnn-odom export``: calibrate, convert, compare, score, write."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from tqdm import tqdm

from rcnn_odom.deployment.odometer import Stepper
from rcnn_odom.deployment.onnx_model import OnnxStepper
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.scores import Report, coverage, coverage_table, score_all, table
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.cache import EncodedSequence
from rcnn_odom.training.checkpoint import calibrate, load_module
from rcnn_odom.training.datamodule import parse_part
from rcnn_odom.training.modules import OdometryModule
from rcnn_odom.training.onnx_graph import check, to_onnx, write, write_metadata
from rcnn_odom.training.run_state import read_settings
from rcnn_odom.training.stages import build_datamodule

if TYPE_CHECKING:
    import onnx

ALLOWED = 0.001
"""Drift, as a ratio, that a precision may cost."""


def export_checkpoint(
    checkpoint: Path, run: Path, out: Path, precision: str, fit_on: list[str] | None = None
) -> None:
    """Writes an ONNX file of a run's checkpoint and prints the drift of each precision.

    Args:
        checkpoint: to export.
        run: the folder with its configuration, by which the test sequences are read.
        out: the file to write.
        precision: ``fp32`` or ``int8``.
        fit_on: drives to fit the uncertainty on anew. None: as it is; where it has not been fitted yet, as
            in a training that was stopped, on the validation sequences.

    Raises:
        InputError: no such checkpoint, no configuration of a run, recordings that are not to be had, drives
            to fit on that were trained or are tested on, a graph that does not do what the checkpoint
            does or costs too much drift.
    """
    module, settings = load_module(checkpoint), read_settings(run)
    data = settings["data"]
    if fit_on:
        seen = sorted(
            {parse_part(name)[0] for name in data["train"] + data["test"]}
            & {parse_part(name)[0] for name in fit_on}
        )
        if seen:
            raise InputError(f"--fit-on: {', '.join(seen)} was trained or is tested on; name other drives")
        data["val"] = fit_on
    fit = bool(fit_on) or not module.uncertainty.fitted
    datamodule = build_datamodule(settings).load(("val", "test") if fit else ("test",))
    if fit:
        module = calibrate(checkpoint, datamodule.sequences["val"])
    sequences = datamodule.sequences["test"]
    steppers, models = _convert(module, dict.fromkeys(("fp32", precision)))
    reports = _score(module, steppers, sequences, data)
    print(table(reports), flush=True)
    if module.uncertainty.fitted:
        print(f"\n{coverage_table(_cover(module, sequences))}\n", flush=True)
    _need_little_cost(reports, precision)
    write_metadata(
        models[precision],
        steppers[precision].metadata | {"drift": _summary(reports[f"onnx {precision}"], data)},
    )
    _write(models[precision], out, checkpoint)


def export_unscored(checkpoint: Path, out: Path, precision: str) -> None:
    """Writes an ONNX file without any recording: compared with the checkpoint on random scans alone.

    Raises:
        InputError: no such checkpoint, or a graph that does not do what it does.
    """
    _, models = _convert(load_module(checkpoint), [precision])
    _write(models[precision], out, checkpoint)


def _convert(
    module: OdometryModule, precisions: Iterable[str]
) -> tuple[dict[str, OnnxStepper], dict[str, "onnx.ModelProto"]]:
    """Graphs, compared with their module, by precision; ready to step, and to be written."""
    models = {precision: to_onnx(module, precision) for precision in precisions}
    steppers = {each: OnnxStepper(model.SerializeToString()) for each, model in models.items()}
    for stepper in steppers.values():
        check(stepper, module)
    return steppers, models


def _write(model: "onnx.ModelProto", out: Path, checkpoint: Path) -> None:
    write(model, out)
    size = out.stat().st_size / 1e6
    print(f"{out}: {size:.1f} MB, its steps compared with those of {checkpoint}")


def _cover(module: OdometryModule, sequences: list[EncodedSequence]) -> dict[str, Report]:
    """How often the truth lies within the deviations, by sequence."""
    drives = {s.name: (module.estimate(torch.from_numpy(np.array(s.scans))), s.motions) for s in sequences}
    return {name: coverage(e.motions, truth, e.deviations) for name, (e, truth) in drives.items()}


def _score(
    module: OdometryModule,
    steppers: dict[str, OnnxStepper],
    sequences: list[EncodedSequence],
    data: dict,
) -> dict[str, Report]:
    """Scores of the checkpoint and of each precision, see :func:`rcnn_odom.evaluation.scores.score_all`."""
    offline = {s.name: module.estimate(torch.from_numpy(np.array(s.scans))).motions for s in sequences}
    estimates = {"checkpoint": offline}
    for precision, stepper in steppers.items():
        estimates[f"onnx {precision}"] = {s.name: stream_motions(stepper, s) for s in sequences}
    return {
        method: score_all(sequences, motions, data["lengths"], data["apply"])
        for method, motions in estimates.items()
    }


def stream_motions(stepper: Stepper, sequence: EncodedSequence) -> FloatArray:
    """Motions (N-1, 2) of a drive, one pair of scans after the other."""
    stepper.reset()
    frames = tqdm(range(len(sequence) - 1), desc=sequence.name, unit="scan", disable=None, leave=False)
    return np.stack([stepper(np.array(sequence.scans[frame : frame + 2]))[0] for frame in frames])


def _need_little_cost(reports: dict[str, Report], precision: str) -> None:
    exact, mine = reports["checkpoint"]["drift"], reports[f"onnx {precision}"]["drift"]
    if exact is None:
        raise InputError("no test sequence has a segment, so that drift says nothing; use --no-drift")
    if not mine - exact <= ALLOWED:  # nan is no low cost either
        advice = "train longer" if precision == "fp32" else "leave out --quantize"
        raise InputError(
            f"{precision} costs {100 * (mine - exact):.2f} percentage points of drift, more than "
            f"{100 * ALLOWED:g}, and is not written; {advice}"
        )


def _summary(report: Report, data: dict) -> Report:
    """What the file tells of its drift, as ratios."""
    by_sequence = {name: one["drift"]["t_err"] for name, one in report["sequences"].items()}
    return {"data": data["name"], "mean": report["drift"], "sequences": by_sequence}
