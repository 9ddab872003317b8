"""Scores of estimated steps: drift, its floor and all metrics; errors of a part of a drive; text tables."""

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
"""Window in frames of the filter that removes the GPS jitter from true distances: about 1 s of KITTI."""


def score(drive: Drive, steps: Steps, lengths: Sequence[float], apply: Apply = "end") -> Report:
    """All scores of one drive.

    Args:
        drive: a drive with ground truth.
        steps: the estimated steps.
        lengths: segment lengths of the drift in metres.
        apply: where along the turn a distance is driven, for the floor.

    Returns:
        ``drift`` of the estimate and ``floor``, the drift of the true steps reduced to distance and heading
        change, both as in the JSON of ``rcnn-odom drift``; ``frames``, the number of scans; the errors of
        single frames (see :func:`rcnn_odom.evaluation.metrics.frame_errors`); and all other metrics.
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
    """Scores of several drives.

    Args:
        drives: drives with ground truth.
        steps: the estimated steps by the name of the drive.
        lengths, apply: as in :func:`score`.

    Returns:
        ``drift`` and ``floor``, ratios, means over the drives that have a segment (None if no drive has
        one); ``lengths``; ``metrics``, each combined over all drives, by name; and ``sequences``, the scores
        of the single drives by name (see :func:`score`).
    """
    scores = {drive.name: score(drive, steps[drive.name], lengths, apply) for drive in drives}
    floors = [each["floor"]["t_err"] for each in scores.values() if each["floor"]["segments"]]
    metrics = combine(scores.values(), all_metrics().values())
    return {
        "drift": metrics["drift"],
        "floor": float(np.mean(floors)) if floors else None,
        "lengths": list(lengths),
        "metrics": metrics,
        "sequences": scores,
    }


def errors_in_deviations(steps: Steps, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors of distance and heading in units of their estimated standard deviations.

    The distance is the projection of the step on the heading in mid-turn. Its deviation is therefore the
    deviation of the position in the direction of the estimated heading in mid-turn.

    Args:
        steps: the estimated steps.
        truth: true steps (N-1, 3).

    Returns:
        The absolute errors divided by the deviations, and the deviations (metres, radians). Both have shape
        (K, 2) for the K steps with at least one known deviation; values of an unknown deviation are nan.

    Example:
        >>> covariance = np.diag([0.1**2, 0.1**2, 0.01**2])  # 0.1 m and 0.01 rad
        >>> steps = Steps(np.array([[1.2, 0.0, 0.0]]), covariance[None])
        >>> ratios, deviations = errors_in_deviations(steps, np.array([[1.0, 0.0, 0.0]]))
        >>> ratios.round(3), deviations.round(3)  # the distance is 0.2 m, two deviations, too long
        (array([[2., 0.]]), array([[0.1 , 0.01]]))
    """
    half = steps.values[:, 2] / 2
    along = np.stack([np.cos(half), np.sin(half)], axis=1)
    distance = np.einsum("ni,nij,nj->n", along, steps.covariances[:, :2, :2], along)
    deviations = np.sqrt(np.stack([distance, steps.covariances[:, 2, 2]], axis=1))
    errors = np.abs(motion_errors(motions_of(steps.values), motions_of(truth)))
    known = np.isfinite(deviations).any(1)
    return errors[known] / deviations[known], deviations[known]


def coverage(steps: Steps, truth: FloatArray) -> Report | None:
    """Share of the errors within one and within two of their estimated standard deviations.

    Args:
        steps: the estimated steps.
        truth: true steps (N-1, 3).

    Returns:
        ``distance`` and ``heading``, each with the shares ``1`` and ``2`` (0.683 and 0.954 for normal errors
        and correct deviations); and the mean estimated deviations ``distance_m`` and ``heading_deg``. The
        entries of a quantity are missing if none of its deviations is known; None if both are missing.

    Example:
        >>> covariance = np.diag([0.1**2, 0.1**2, 0.01**2])  # 0.1 m and 0.01 rad
        >>> steps = Steps(np.array([[1.15, 0.0, 0.0], [1.05, 0.0, 0.0]]), np.stack([covariance] * 2))
        >>> coverage(steps, np.array([[1.0, 0.0, 0.0]] * 2))["distance"]  # errors of 0.15 and 0.05 m
        {'1': 0.5, '2': 1.0}
    """
    ratios, deviations = errors_in_deviations(steps, truth)
    report: Report = {}
    for column, (name, unit, scale) in enumerate((("distance", "m", 1), ("heading", "deg", 180 / np.pi))):
        known = np.isfinite(deviations[:, column])
        if known.any():
            within = {str(times): float((ratios[known, column] <= times).mean()) for times in (1, 2)}
            report |= {name: within, f"{name}_{unit}": float(scale * deviations[known, column].mean())}
    return report or None


def stretch_errors(motions: FloatArray, truth: FloatArray, chosen: slice, apply: Apply = "end") -> Report:
    """Errors of a part of a drive: of its single frames and of its end point.

    Args:
        motions: estimated motions of the whole drive, (N, 2), metres and radians.
        truth: true motions of the whole drive, (N, 2).
        chosen: rows of the part, at least one.
        apply: where along the turn a distance is driven, for both.

    Returns:
        The entries of :func:`rcnn_odom.evaluation.metrics.frame_errors`; ``smoothed_distance_*``, the errors
        against the smoothed true distance; ``path_m``, the true path length of the part; ``end_m``, the
        error of the end point if the motions are composed from the start of the part; and ``end_ratio``, this
        error divided by the path length (None if the path length is 0).

    Example:
        >>> truth = np.array([[1.0, 0.0]] * 4)  # straight ahead, 1 m a frame
        >>> errors = stretch_errors(truth + [0.1, 0.0], truth, slice(0, 2))  # 0.1 m a frame too long
        >>> errors["path_m"], round(errors["end_m"], 3), round(errors["end_ratio"], 3)
        (2.0, 0.2, 0.1)
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
    """Length of the estimated path divided by that of the true path; None if the true length is 0.

    A value far below 1 shows that the estimate often stands still.
    """
    path, true_path = (float(np.hypot(*every[:, :2].T).sum()) for every in (steps.values, drive.steps))
    return path / true_path if true_path else None


def smooth(distances: FloatArray) -> FloatArray:
    """Removes the jitter of a GPS from distances (N,): Savitzky-Golay filter of order 2.

    The window has ``SMOOTHING`` frames, or the largest odd number of frames that fits into a shorter drive.
    Up to four distances are returned without a change.
    """
    from scipy.signal import savgol_filter  # The import takes a second, and training does not need it.

    window = min(SMOOTHING, len(distances) - (len(distances) + 1) % 2)
    smoothed: FloatArray = savgol_filter(distances, window, polyorder=min(2, window - 1))
    return smoothed


def table(reports: Mapping[str, Report]) -> str:
    """Text table of the drift in percent, with a row for each method and a column for each sequence.

    Args:
        reports: results of :func:`score_all` by the name of the method, all on the same sequences.
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
    """Text table of all metrics except the drift over all sequences, with a row for each method.

    Args:
        reports: results of :func:`score_all` by the name of the method.
    """
    metrics = [metric for metric in all_metrics().values() if metric.name != "drift"]
    header = ["over all sequences", *(f"{metric.title} ({metric.unit})" for metric in metrics)]
    rows = [
        [metric.show(report["metrics"][metric.name]) for metric in metrics] for report in reports.values()
    ]
    return aligned([header, *([method, *row] for method, row in zip(reports, rows, strict=True))])


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Text table: the first column is aligned to the left, the other columns to the right.

    Example:
        >>> print(aligned([["drift in %", "05"], ["matcher", "0.52"]]))
        drift in %    05
        matcher     0.52
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for label, *cells in rows:
        padded = [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
        lines.append("  ".join([label.ljust(widths[0]), *padded]).rstrip())
    return "\n".join(lines)


def percent(ratio: float | None) -> str:
    """Formats a ratio in percent; a dash for None, where no segment was long enough.

    Example:
        >>> percent(0.0255), percent(None)
        ('2.55', '-')
    """
    return "-" if ratio is None else f"{100 * ratio:.2f}"


def coverage_table(reports: Mapping[str, Report]) -> str:
    """Text table of the share of errors within one and two deviations, with a row for each sequence.

    Args:
        reports: results of :func:`coverage` by the name of the sequence.
    """
    columns = [(name, times) for name in ("distance", "heading") for times in ("1", "2")]
    title = "errors within 1 or 2 deviations, %"
    rows = [[title, *(f"{name} {times}" for name, times in columns), "mean, m", "mean, deg"]]
    rows.append(["normal errors", *["68.3", "95.4"] * 2, "", ""])
    for sequence, report in reports.items():
        shares = [f"{100 * report[name][times]:.1f}" if name in report else "-" for name, times in columns]
        means = [f"{report[name]:.3f}" if name in report else "-" for name in ("distance_m", "heading_deg")]
        rows.append([sequence, *shares, *means])
    return aligned(rows)


def frame_table(reports: Mapping[str, Report]) -> str:
    """Text table of the frame errors and the error of the end point, with a row for each method.

    Args:
        reports: results of :func:`stretch_errors` by the name of the method.
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
