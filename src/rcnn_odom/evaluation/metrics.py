"""The metrics of an estimate: each is defined once, with its name, its unit and its format.

Scores, tables, reports and logs take the metrics from :func:`all_metrics`, which includes those of other
packages (entry points ``rcnn_odom.metrics``, see docs/extending.md).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import Drift, drift
from rcnn_odom.geometry import FloatArray, Steps, change_frame, motion_errors, motions_of
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.registry import collect

Report = dict[str, Any]
"""Numbers, lists and dictionaries by name, ready for JSON."""

STANDING = (0.01, np.deg2rad(0.2))
"""A frame that moves less than this (metres, radians) counts as standing: good odometry has this noise."""


@dataclass(frozen=True)
class Metric:
    """A metric: how one number of an estimate is computed, combined and shown.

    Attributes:
        name: name in files and logs, with the unit, for instance ``distance_mae_m``.
        title: heading of its column in tables, without the unit.
        unit: unit in tables.
        better: which values are better: ``lower``, ``higher``, or ``zero`` for a signed error, which is
            shown with its sign.
        compute: function of a drive with ground truth, the estimated steps and the segment lengths of the
            drift in metres; returns the value, or None if the drive has none.
        combine: how the values of several drives become one: ``mean`` (over drives), ``frames`` (mean over
            all frames) or ``max`` (the largest); drives without a value do not count.
        scale: factor from the stored unit to the shown unit, for instance 100 from a ratio to %.
        digits: number of decimals in tables.
        in_training: whether it is also logged for the validation drives after each epoch.

    Example:
        >>> share = Metric("share", "share", "%", "lower", lambda drive, steps, lengths: 0.1, scale=100)
        >>> share.show(0.1), share.show(None)
        ('10.00', '-')
        >>> round(share.over([0.1, None, 0.3], frames=[10, 10, 10]), 3)
        0.2
    """

    name: str
    title: str
    unit: str
    better: Literal["lower", "higher", "zero"]
    compute: Callable[[Drive, Steps, Sequence[float]], float | None]
    combine: Literal["mean", "frames", "max"] = "mean"
    scale: float = 1.0
    digits: int = 2
    in_training: bool = False

    def show(self, value: float | None) -> str:
        """Formats a value in the shown unit; a dash for None."""
        sign = "+" if self.better == "zero" else ""
        return "-" if value is None else f"{self.scale * value:{sign}.{self.digits}f}"

    def over(self, values: Sequence[float | None], frames: Sequence[int]) -> float | None:
        """Combines the values of several drives into one.

        Args:
            values: of the drives, in the stored unit; None for a drive without a value.
            frames: number of steps of each drive.

        Returns:
            The combined value in the stored unit; None if no drive has a value.
        """
        known = [(value, count) for value, count in zip(values, frames, strict=True) if value is not None]
        if not known:
            return None
        if self.combine == "max":
            return max(value for value, _ in known)
        weights = [count if self.combine == "frames" else 1 for _, count in known]
        return float(np.average([value for value, _ in known], weights=weights))


def planar_drift(drive: Drive, steps: Steps, lengths: Sequence[float]) -> Drift:
    """Drift of estimated steps in the plane, the same as of ``rcnn-odom drift --planar``."""
    estimate = change_frame(steps.poses(), drive.camera_from_laser)
    return drift(drive.camera_poses, estimate, planar=True, lengths=lengths)


def frame_errors(motions: FloatArray, truth: FloatArray) -> Report:
    """Errors of single frames: mean absolute, mean signed and largest error of distance and heading.

    Args:
        motions: estimated, (N, 2), metres and radians.
        truth: of the same frames, (N, 2).

    Returns:
        ``distance_mae_m``, ``distance_bias_m``, ``distance_max_m``, ``heading_mae_deg`` and so on over all
        frames; under ``moving`` and ``standing`` the same over the frames that move or stand still in the
        ground truth, and their number ``frames``.

    Example:
        >>> errors = frame_errors(np.array([[1.1, 0.0], [0.9, 0.0]]), np.array([[1.0, 0.0], [1.0, 0.0]]))
        >>> round(errors["distance_mae_m"], 3), round(errors["distance_bias_m"], 3)
        (0.1, 0.0)
    """
    error = motion_errors(motions, truth)
    standing = (np.abs(truth) < STANDING).all(1)
    report = _errors(error)
    for name, chosen in (("moving", ~standing), ("standing", standing)):
        report[name] = {"frames": int(chosen.sum()), **(_errors(error[chosen]) if chosen.any() else {})}
    return report


def _errors(error: FloatArray) -> Report:
    """Mean absolute, mean signed and largest of errors (N, 2) in metres and radians."""
    report = {}
    for name, values in (("distance_{}_m", error[:, 0]), ("heading_{}_deg", np.rad2deg(error[:, 1]))):
        report[name.format("mae")] = float(np.abs(values).mean())
        report[name.format("bias")] = float(values.mean())
        report[name.format("max")] = float(np.abs(values).max())
    return report


def _drift(drive: Drive, steps: Steps, lengths: Sequence[float], part: str) -> float | None:
    value: float | None = getattr(planar_drift(drive, steps, lengths), part)
    return value


def _frame_error(drive: Drive, steps: Steps, lengths: Sequence[float], name: str) -> float:
    value: float = _errors(motion_errors(motions_of(steps.values), drive.motions))[name]
    return value


def _frame_metrics(quantity: str, unit: str) -> list[Metric]:
    """The three metrics of a quantity of single frames, ``distance`` in m or ``heading`` in deg."""
    mae, bias, largest = (f"{quantity}_{kind}_{unit}" for kind in ("mae", "bias", "max"))
    compute_mae, compute_bias, compute_largest = (
        partial(_frame_error, name=name) for name in (mae, bias, largest)
    )
    return [
        Metric(
            mae, f"{quantity}, mean abs", unit, "lower", compute_mae, "frames", digits=4, in_training=True
        ),
        Metric(bias, f"{quantity}, signed", unit, "zero", compute_bias, "frames", digits=4),
        Metric(largest, f"{quantity}, largest", unit, "lower", compute_largest, "max", digits=3),
    ]


DRIFT = Metric("drift", "drift", "%", "lower", partial(_drift, part="t_err"), scale=100, in_training=True)
BUILT_IN = [
    DRIFT,
    Metric(
        "rotation_deg_per_m", "rotation", "deg/m", "lower", partial(_drift, part="r_err_deg_per_m"), digits=4
    ),
    *_frame_metrics("distance", "m"),
    *_frame_metrics("heading", "deg"),
]
"""The metrics of this project, in the order of the tables."""

RESERVED_NAMES = ("frames", "floor", "moving", "standing")
"""Other entries of a drive's scores; no metric may have one of these names."""


def check_metric(name: str, metric: Any) -> None:
    """Checks that an object which another package registers is a metric.

    Raises:
        InputError: it is not a metric, it has another name than its entry point, or its function or its way
            to combine drives is invalid.
    """
    if not isinstance(metric, Metric):
        raise InputError(f"metric {name}: is not a Metric of rcnn_odom.evaluation.metrics; make it one")
    if metric.name != name or name in RESERVED_NAMES:
        raise InputError(
            f"metric {name}: is named {metric.name}; use one name for both, and none of {RESERVED_NAMES}"
        )
    if not callable(metric.compute) or metric.combine not in ("mean", "frames", "max"):
        raise InputError(f"metric {name}: give it a function compute, and set combine to mean, frames or max")


def all_metrics() -> dict[str, Metric]:
    """All metrics by name, those of this project first.

    Raises:
        InputError: two have the same name, or another package registers an object that is not a metric.
    """
    return collect("metric", {metric.name: metric for metric in BUILT_IN}, check_metric)


def score_metrics(drive: Drive, steps: Steps, lengths: Sequence[float]) -> dict[str, float | None]:
    """Computes all metrics of one drive, by name; None for a metric that has no finite value there.

    Args:
        drive: a drive with ground truth.
        steps: the estimated steps.
        lengths: segment lengths of the drift in metres.
    """
    values = {name: metric.compute(drive, steps, lengths) for name, metric in all_metrics().items()}
    return {
        # JSON cannot store the floats of numpy that a metric may return.
        name: None if value is None or not np.isfinite(value) else float(value)
        for name, value in values.items()
    }


def combine(sequences: Iterable[Mapping[str, Any]], metrics: Iterable[Metric]) -> dict[str, float | None]:
    """Combines each metric over several drives; the results are by name.

    Args:
        sequences: the scores of the drives, as in ``sequences`` of a ``metrics.json``.
        metrics: the metrics to combine.

    Raises:
        KeyError, TypeError: the scores have another form, or lack one of the metrics.
    """
    sequences = list(sequences)
    frames = [sequence["frames"] - 1 for sequence in sequences]
    return {
        metric.name: metric.over([read_metric(sequence, metric.name) for sequence in sequences], frames)
        for metric in metrics
    }


def read_metric(sequence: Mapping[str, Any], name: str) -> float | None:
    """Reads the value of a metric from one of the ``sequences`` of a ``metrics.json``.

    The two metrics of the drift are in the group ``drift`` there, under other names.
    """
    in_drift = {"drift": "t_err", "rotation_deg_per_m": "r_err_deg_per_m"}
    value: float | None = sequence["drift"][in_drift[name]] if name in in_drift else sequence[name]
    return value
