"""Scores of estimated steps: drift, its floor, every metric; errors of a stretch; tables for terminals."""

from collections.abc import Mapping, Sequence

import numpy as np

from rcnn_odom.evaluation.metrics import (
    Report,
    all_metrics,
    combine,
    frame_errors,
    planar_drift,
    score_metrics,
)
from rcnn_odom.geometry import FloatArray, Steps, compose, motion_errors, motions_of
from rcnn_odom.models.two_numbers import Apply, restate, steps_of
from rcnn_odom.recordings.recording import Drive

SMOOTHING = 11
"""Frames under the filter that takes the jitter out of a true distance: a second of KITTI."""


def score(drive: Drive, steps: Steps, lengths: Sequence[float], apply: Apply = "end") -> Report:
    """Everything that is reported of one drive.

    Args:
        drive: with its truth.
        steps: estimated.
        lengths: of the drift's segments in metres.
        apply: where along its turn a distance is driven, for the floor.

    Returns:
        ``drift`` of the estimate and ``floor``, the drift of the true steps cut to two numbers, both as the
        command line prints them; the errors of single frames; and every other metric.
    """
    floor = Steps.with_unknown_covariance(restate(drive.steps, apply))
    return {
        **score_metrics(drive, steps, lengths),
        "frames": len(drive),
        "drift": planar_drift(drive, steps, lengths).to_dict(),
        "floor": planar_drift(drive, floor, lengths).to_dict(),
        **frame_errors(motions_of(steps.values), drive.motions),
    }


def score_all(
    drives: Sequence[Drive], steps: Mapping[str, Steps], lengths: Sequence[float], apply: Apply = "end"
) -> Report:
    """Scores of all drives.

    Args:
        drives: with their truth.
        steps: estimated, by the name of the drive.
        lengths, apply: as in :func:`score`.

    Returns:
        ``drift`` and ``floor`` (means over the drives that have a segment, ratios; None without any),
        ``lengths``, ``metrics`` (each over all drives, by name), and the drives' own scores under
        ``sequences``, see :func:`score`.
    """
    scores = {drive.name: score(drive, steps[drive.name], lengths, apply) for drive in drives}
    floors = [one["floor"]["t_err"] for one in scores.values() if one["floor"]["segments"]]
    metrics = combine(scores.values(), all_metrics().values())
    return {
        "drift": metrics["drift"],
        "floor": float(np.mean(floors)) if floors else None,
        "lengths": list(lengths),
        "metrics": metrics,
        "sequences": scores,
    }


def in_deviations(steps: Steps, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors of distance and heading in units of their estimated standard deviations.

    The deviation of the distance is that along the estimated heading in mid-turn, where the distance is too.

    Args:
        steps: estimated.
        truth: true steps (N-1, 3).

    Returns:
        Absolute errors over deviations, and the deviations (metres, radians), each (K, 2), of the K steps
        of which one deviation at least is known; the other may be nan.
    """
    half = steps.values[:, 2] / 2
    along = np.stack([np.cos(half), np.sin(half)], axis=1)
    distance = np.einsum("ni,nij,nj->n", along, steps.covariances[:, :2, :2], along)
    deviations = np.sqrt(np.stack([distance, steps.covariances[:, 2, 2]], axis=1))
    errors = np.abs(motion_errors(motions_of(steps.values), motions_of(truth)))
    known = np.isfinite(deviations).any(1)
    return errors[known] / deviations[known], deviations[known]


def coverage(steps: Steps, truth: FloatArray) -> Report | None:
    """How often the truth lies within one and two of the estimated standard deviations.

    Args:
        steps: estimated.
        truth: true steps (N-1, 3).

    Returns:
        Shares under ``distance`` and ``heading``, there under ``1`` and ``2``: 0.683 and 0.954 for normal
        errors and true deviations; and the mean deviations ``distance_m`` and ``heading_deg``. Without
        those of the distance where no deviation of a distance is known; None where none is at all.
    """
    ratios, deviations = in_deviations(steps, truth)
    report: Report = {}
    for column, (name, unit, scale) in enumerate((("distance", "m", 1), ("heading", "deg", 180 / np.pi))):
        known = np.isfinite(deviations[:, column])
        if known.any():
            within = {str(times): float((ratios[known, column] <= times).mean()) for times in (1, 2)}
            report |= {name: within, f"{name}_{unit}": float(scale * deviations[known, column].mean())}
    return report or None


def stretch_errors(motions: FloatArray, truth: FloatArray, chosen: slice, apply: Apply = "end") -> Report:
    """Errors of a stretch of a drive: of its single frames, and of the place where it ends.

    Args:
        motions: estimated, of the whole drive, (N, 2) metres and radians.
        truth: of the whole drive, (N, 2).
        chosen: rows of the stretch, at least one.
        apply: where along its turn a distance is driven, for both.

    Returns:
        What :func:`frame_errors` gives, ``smoothed_distance_*`` against the smoothed true distance,
        ``path_m``, and of the motions composed from the stretch's start ``end_m`` and ``end_ratio``, the
        part of the path (None where the truth stands still).
    """
    report = frame_errors(motions[chosen], truth[chosen])
    smoothed = np.column_stack([smooth(truth[:, 0]), truth[:, 1]])
    against_smoothed = frame_errors(motions[chosen], smoothed[chosen])
    for name in ("distance_mae_m", "distance_bias_m", "distance_max_m"):
        report[f"smoothed_{name}"] = against_smoothed[name]
    estimate_end, true_end = (
        compose(steps_of(every[chosen], apply))[-1, :3, 3] for every in (motions, truth)
    )
    end, path = float(np.linalg.norm(estimate_end - true_end)), float(np.abs(truth[chosen, 0]).sum())
    return {**report, "path_m": path, "end_m": end, "end_ratio": end / path if path else None}


def path_ratio(steps: Steps, drive: Drive) -> float | None:
    """Length of the estimated path over that of the true one: far below 1 where an estimate stands still.

    Returns:
        None where the truth stands still.
    """
    path, true_path = (float(np.hypot(*every[:, :2].T).sum()) for every in (steps.values, drive.steps))
    return path / true_path if true_path else None


def smooth(distances: FloatArray) -> FloatArray:
    """Distances (N,) without the jitter of a GPS: Savitzky-Golay, parabolas over ``SMOOTHING`` frames.

    Fewer frames are smoothed over the largest odd number of them; up to four come back as they are.
    """
    from scipy.signal import savgol_filter  # A second to import, which a training has no use for.

    window = min(SMOOTHING, len(distances) - (len(distances) + 1) % 2)
    smoothed: FloatArray = savgol_filter(distances, window, polyorder=min(2, window - 1))
    return smoothed


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


def metrics_table(reports: Mapping[str, Report]) -> str:
    """Text with a row for each method and a column for each metric over all sequences, without the drift.

    Args:
        reports: of :func:`score_all` by the name of the method.
    """
    metrics = [metric for metric in all_metrics().values() if metric.name != "drift"]
    header = ["over all sequences", *(f"{metric.title} ({metric.unit})" for metric in metrics)]
    rows = [
        [metric.show(report["metrics"][metric.name]) for metric in metrics] for report in reports.values()
    ]
    return aligned([header, *([method, *row] for method, row in zip(reports, rows, strict=True))])


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
        shares = [f"{100 * report[name][times]:.1f}" if name in report else "-" for name, times in columns]
        means = [f"{report[name]:.3f}" if name in report else "-" for name in ("distance_m", "heading_deg")]
        rows.append([sequence, *shares, *means])
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
