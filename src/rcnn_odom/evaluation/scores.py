"""Scores of estimated motions: drift, its floor, and the errors of single frames; files of motions."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rcnn_odom.evaluation.drift import Drift, drift
from rcnn_odom.geometry import ApplyStep, FloatArray, change_frame, compose, motion_errors
from rcnn_odom.recordings.cache import EncodedSequence

STANDING = (0.01, np.deg2rad(0.2))
"""A frame stands still when it moves less than this, metres and radians: the noise of good odometry."""
SMOOTHING = 11
"""Frames under the filter that takes the jitter out of a true distance: a second of KITTI."""

Report = dict[str, Any]
"""Plain numbers under names, ready for JSON."""


def camera_trajectory(sequence: EncodedSequence, motions: FloatArray, apply: ApplyStep) -> FloatArray:
    """Estimated poses (N, 4, 4) of motions (N-1, 2) in the frame of the sequence's trajectory files."""
    return change_frame(compose(motions, apply), sequence.camera_from_laser)


def planar_drift(sequence: EncodedSequence, poses: FloatArray, lengths: list[float]) -> Drift:
    """Drift of laser poses (N, 4, 4) over one sequence, as ``rcnn-odom drift --planar`` prints it."""
    estimate = change_frame(poses, sequence.camera_from_laser)
    return drift(sequence.camera_poses, estimate, planar=True, lengths=lengths)


def score(
    sequence: EncodedSequence,
    motions: FloatArray,
    lengths: list[float],
    apply: ApplyStep = "end",
    poses: FloatArray | None = None,
) -> Report:
    """Everything that is reported of one sequence.

    Args:
        sequence: with its truth.
        motions: estimated, (N-1, 2) metres and radians.
        lengths: of the drift's segments in metres.
        apply: where along its turn a step is taken, for the estimate and the floor.
        poses: estimated laser poses (N, 4, 4), the first the identity, of a method that also knows the
            step's sideways part; their drift is scored in place of the composed motions'.

    Returns:
        ``drift`` of the estimate and ``floor`` of the true motions composed the same way, both as the
        command line prints them, and the errors of single frames.
    """
    poses = compose(motions, apply) if poses is None else poses
    return {
        "frames": len(sequence),
        "drift": planar_drift(sequence, poses, lengths).to_dict(),
        "floor": planar_drift(sequence, compose(sequence.motions, apply), lengths).to_dict(),
        **frame_errors(motions, sequence.motions),
    }


def frame_errors(motions: FloatArray, truth: FloatArray) -> Report:
    """Errors of motions (N, 2) against the truth (N, 2): mean absolute, mean signed, largest.

    Frames that move and frames that stand still, by the truth, are also told apart.
    """
    error = motion_errors(motions, truth)
    standing = (np.abs(truth) < STANDING).all(1)
    report = _errors(error)
    for name, chosen in (("moving", ~standing), ("standing", standing)):
        report[name] = {"frames": int(chosen.sum()), **(_errors(error[chosen]) if chosen.any() else {})}
    return report


def coverage(motions: FloatArray, truth: FloatArray, deviations: FloatArray) -> Report:
    """How often the truth lies within one and two of the estimated standard deviations.

    Args:
        motions, truth, deviations: (N, 2) metres and radians.

    Returns:
        Shares under ``distance`` and ``heading``, there under ``1`` and ``2``: 0.683 and 0.954 for normal
        errors and true deviations; and the mean deviations ``distance_m`` and ``heading_deg``.
    """
    ratios = np.abs(motion_errors(motions, truth)) / deviations
    report: Report = {
        name: {str(times): float((ratios[:, output] <= times).mean()) for times in (1, 2)}
        for output, name in enumerate(("distance", "heading"))
    }
    report["distance_m"], report["heading_deg"] = (
        float(deviations[:, 0].mean()),
        float(np.rad2deg(deviations[:, 1]).mean()),
    )
    return report


def _errors(error: FloatArray) -> Report:
    report = {}
    for name, values in (("distance_{}_m", error[:, 0]), ("heading_{}_deg", np.rad2deg(error[:, 1]))):
        report[name.format("mae")] = float(np.abs(values).mean())
        report[name.format("bias")] = float(values.mean())
        report[name.format("max")] = float(np.abs(values).max())
    return report


def stretch_errors(motions: FloatArray, truth: FloatArray, chosen: slice, apply: ApplyStep = "end") -> Report:
    """Errors of a stretch of a drive: of its single frames, and of the place where it ends.

    Args:
        motions: estimated, of the whole drive, (N, 2) metres and radians.
        truth: of the whole drive, (N, 2).
        chosen: rows of the stretch, at least one.
        apply: where along its turn a step is taken, for both.

    Returns:
        What :func:`frame_errors` tells, ``smoothed_distance_*`` against the smoothed true distance,
        ``path_m``, and of the motions composed from the stretch's start ``end_m`` and ``end_ratio``, the
        part of the path (None where the truth stands still).
    """
    report = frame_errors(motions[chosen], truth[chosen])
    smoothed = np.column_stack([smooth(truth[:, 0]), truth[:, 1]])
    against_smoothed = frame_errors(motions[chosen], smoothed[chosen])
    for name in ("distance_mae_m", "distance_bias_m", "distance_max_m"):
        report[f"smoothed_{name}"] = against_smoothed[name]
    estimate_end, true_end = (compose(every[chosen], apply)[-1, :3, 3] for every in (motions, truth))
    end, path = float(np.linalg.norm(estimate_end - true_end)), float(np.abs(truth[chosen, 0]).sum())
    return {**report, "path_m": path, "end_m": end, "end_ratio": end / path if path else None}


def smooth(distances: FloatArray) -> FloatArray:
    """Distances (N,) without the jitter of a GPS: Savitzky-Golay, parabolas over ``SMOOTHING`` frames.

    Fewer frames are smoothed over the largest odd number of them; up to four come back as they are.
    """
    from scipy.signal import savgol_filter  # A second to import, which a training has no use for.

    window = min(SMOOTHING, len(distances) - (len(distances) + 1) % 2)
    smoothed: FloatArray = savgol_filter(distances, window, polyorder=min(2, window - 1))
    return smoothed


def score_all(
    sequences: list[EncodedSequence],
    motions: Mapping[str, FloatArray],
    lengths: list[float],
    apply: ApplyStep = "end",
    poses: Mapping[str, FloatArray] | None = None,
) -> Report:
    """Scores of all sequences by name, and the means over those that have a segment; see :func:`score`.

    Returns:
        ``drift`` and ``floor`` (ratios; None without any segment) and ``sequences``.
    """
    poses = poses or {}
    scores = {s.name: score(s, motions[s.name], lengths, apply, poses.get(s.name)) for s in sequences}
    report: Report = {}
    for key in ("drift", "floor"):
        drifts = [one[key]["t_err"] for one in scores.values() if one[key]["segments"]]
        report[key] = float(np.mean(drifts)) if drifts else None
    return {**report, "lengths": list(lengths), "sequences": scores}


def table(reports: Mapping[str, Report]) -> str:
    """Text with a row for each method and a column for each sequence, drift in percent.

    Args:
        reports: of :func:`score_all` by the name of the method, all on the same sequences.
    """
    first = next(iter(reports.values()))
    names = list(first["sequences"])
    rows = [["drift in %", *names, "mean"]]
    floors = {name: first["sequences"][name]["floor"]["t_err"] for name in names}
    rows.append(["floor of two-number motion", *map(percent, floors.values()), percent(first["floor"])])
    for method, report in reports.items():
        drifts = [report["sequences"][name]["drift"]["t_err"] for name in names]
        rows.append([method, *map(percent, drifts), percent(report["drift"])])
    segments = [first["sequences"][name]["drift"]["segments"] for name in names]
    rows.append(["segments", *map(str, segments), ""])
    return aligned(rows)


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells for a terminal, the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for label, *cells in rows:
        padded = [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
        lines.append("  ".join([label.ljust(widths[0]), *padded]).rstrip())
    return "\n".join(lines)


def percent(ratio: float | None) -> str:
    """A ratio in percent; a dash where no segment was long enough to have one."""
    return "-" if ratio is None else f"{100 * ratio:.2f}"


def coverage_table(reports: Mapping[str, Report]) -> str:
    """Text with a row for each sequence: how often the truth lies within the deviations, in percent.

    Args:
        reports: of :func:`coverage` by the name of the sequence.
    """
    columns = [(name, times) for name in ("distance", "heading") for times in ("1", "2")]
    title = "truth within so many deviations, %"
    rows = [[title, *(f"{name} {times}" for name, times in columns), "mean, m", "mean, deg"]]
    rows.append(["of normal errors", *["68.3", "95.4"] * 2, "", ""])
    for sequence, report in reports.items():
        shares = [f"{100 * report[name][times]:.1f}" for name, times in columns]
        rows.append([sequence, *shares, f"{report['distance_m']:.3f}", f"{report['heading_deg']:.3f}"])
    return aligned(rows)


def frame_table(reports: Mapping[str, Report]) -> str:
    """Text with a row for each method: errors of distance and heading a frame, and of the end point.

    Args:
        reports: of :func:`stretch_errors` by the name of the method.
    """
    label, width = max(map(len, reports)), 10
    groups = {"distance, m": 3, "to smoothed truth, m": 3, "heading, deg": 3, "end point": 2}
    titles = ["  " + f" {title} ".center(width * count - 2, "-") for title, count in groups.items()]
    names = [*["mean abs", "signed", "largest"] * 3, "m", "% of path"]
    lines = [" " * label + "".join(titles), " " * label + "".join(name.rjust(width) for name in names)]
    for method, report in reports.items():
        cells = []
        for kind in ("distance_{}_m", "smoothed_distance_{}_m", "heading_{}_deg"):
            mae, bias, largest = (report[kind.format(name)] for name in ("mae", "bias", "max"))
            cells += [f"{mae:.4f}", f"{bias:+.4f}", f"{largest:.4f}"]
        cells += [f"{report['end_m']:.3f}", percent(report["end_ratio"])]
        lines.append(method.ljust(label) + "".join(cell.rjust(width) for cell in cells))
    return "\n".join(lines)
