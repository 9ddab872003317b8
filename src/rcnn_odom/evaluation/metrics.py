"""What is measured of an estimate: every metric once, with its name, its unit and how it is shown.

Scores, tables, reports and logs take what there is from :func:`all_metrics`, those of other packages too
(entry points ``rcnn_odom.metrics``, docs/extending.md).
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
"""Plain numbers under names, ready for JSON."""

STANDING = (0.01, np.deg2rad(0.2))
"""A frame stands still when it moves less than this, metres and radians: the noise of good odometry."""


@dataclass(frozen=True)
class Metric:
    """One number of an estimate.

    Attributes:
        name: under which it is stored and logged, with its unit, such as ``distance_mae_m``.
        title: of its column, without the unit.
        unit: in which it is shown.
        better: ``lower``, ``higher``, or ``zero`` of a signed error, which is shown with its sign.
        compute: its value out of a drive with its truth, the estimated steps and the drift's lengths in
            metres; None where the drive has none.
        combine: one value of several drives: the ``mean`` over drives, the mean over all ``frames``, or the
            largest (``max``); drives without a value do not count.
        scale: from the stored value to the unit that is shown: 100 from a ratio to %.
        digits: decimals that are shown.
        in_training: whether it is also logged on the validation drives after each epoch.
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
        """A value in the metric's unit; a dash where there is none."""
        sign = "+" if self.better == "zero" else ""
        return "-" if value is None else f"{self.scale * value:{sign}.{self.digits}f}"

    def over(self, values: Sequence[float | None], frames: Sequence[int]) -> float | None:
        """One value of several drives.

        Args:
            values: of the drives, in the stored unit.
            frames: how many steps each of them has.
        """
        known = [(value, count) for value, count in zip(values, frames, strict=True) if value is not None]
        if not known:
            return None
        if self.combine == "max":
            return max(value for value, _ in known)
        weights = [count if self.combine == "frames" else 1 for _, count in known]
        return float(np.average([value for value, _ in known], weights=weights))


def planar_drift(drive: Drive, steps: Steps, lengths: Sequence[float]) -> Drift:
    """Drift of estimated steps, as ``rcnn-odom drift --planar`` prints it."""
    estimate = change_frame(steps.poses(), drive.camera_from_laser)
    return drift(drive.camera_poses, estimate, planar=True, lengths=lengths)


def frame_errors(motions: FloatArray, truth: FloatArray) -> Report:
    """Errors of motions (N, 2) against the truth (N, 2): mean absolute, mean signed, largest.

    Frames that move and frames that stand still, by the truth, are also counted apart.
    """
    error = motion_errors(motions, truth)
    standing = (np.abs(truth) < STANDING).all(1)
    report = _errors(error)
    for name, chosen in (("moving", ~standing), ("standing", standing)):
        report[name] = {"frames": int(chosen.sum()), **(_errors(error[chosen]) if chosen.any() else {})}
    return report


def _errors(error: FloatArray) -> Report:
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
    mae, bias, largest = (f"{quantity}_{kind}_{unit}" for kind in ("mae", "bias", "max"))
    of_mae, of_bias, of_largest = (partial(_frame_error, name=name) for name in (mae, bias, largest))
    return [
        Metric(mae, f"{quantity}, mean abs", unit, "lower", of_mae, "frames", digits=4, in_training=True),
        Metric(bias, f"{quantity}, signed", unit, "zero", of_bias, "frames", digits=4),
        Metric(largest, f"{quantity}, largest", unit, "lower", of_largest, "max", digits=3),
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
"""The project's own, in the order of tables."""

TAKEN = ("frames", "floor", "moving", "standing")
"""What else a drive's scores have."""


def check_metric(name: str, metric: Any) -> None:
    """Looks whether what a package adds is a metric.

    Raises:
        InputError: it is not, or has no way to compute or to combine it.
    """
    if not isinstance(metric, Metric):
        raise InputError(f"metric {name}: is no Metric of rcnn_odom.evaluation.metrics; make it one")
    if metric.name != name or name in TAKEN:
        raise InputError(f"metric {name}: is named {metric.name}; both must be the same, and not {TAKEN}")
    if not callable(metric.compute) or metric.combine not in ("mean", "frames", "max"):
        raise InputError(f"metric {name}: give a function to compute it, and combine mean, frames or max")


def all_metrics() -> dict[str, Metric]:
    """Every metric by its name, the project's own first.

    Raises:
        InputError: two have the same name, or one that a package adds is no metric.
    """
    return collect("metric", {metric.name: metric for metric in BUILT_IN}, check_metric)


def score_metrics(drive: Drive, steps: Steps, lengths: Sequence[float]) -> dict[str, float | None]:
    """Every metric of one drive by its name; None where the drive has none.

    Args:
        drive: with its truth.
        steps: estimated.
        lengths: of the drift's segments in metres.
    """
    values = {name: metric.compute(drive, steps, lengths) for name, metric in all_metrics().items()}
    return {
        # Plain floats, also of a metric that gives numpy's, which JSON does not know.
        name: None if value is None or not np.isfinite(value) else float(value)
        for name, value in values.items()
    }


def combine(sequences: Iterable[Mapping[str, Any]], metrics: Iterable[Metric]) -> dict[str, float | None]:
    """Each metric over several drives, by its name.

    Args:
        sequences: ``sequences`` of a ``metrics.json``.
        metrics: to combine.

    Raises:
        KeyError, TypeError: the sequences are not of that form, or lack one of the metrics.
    """
    sequences = list(sequences)
    frames = [one["frames"] - 1 for one in sequences]
    return {
        metric.name: metric.over([value_in(one, metric.name) for one in sequences], frames)
        for metric in metrics
    }


def value_in(sequence: Mapping[str, Any], name: str) -> float | None:
    """A metric's value in one of the ``sequences`` of a ``metrics.json``, where drift is a group."""
    in_drift = {"drift": "t_err", "rotation_deg_per_m": "r_err_deg_per_m"}
    value: float | None = sequence["drift"][in_drift[name]] if name in in_drift else sequence[name]
    return value
