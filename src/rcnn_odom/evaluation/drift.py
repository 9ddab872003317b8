"""Drift of a trajectory by the rule of KITTI's development kit (Geiger et al. 2012), in numpy.

Segments of given lengths start every few frames; a segment's error is how far the estimated relative
pose of its ends is from the true one, divided by the length. All poses are (N, 4, 4) of the camera
(x right, y down, z forward).
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.trajectory import flatten

KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Segment lengths of KITTI's benchmark in metres."""

LADDER = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
"""Lengths in metres to fall back on where the wanted ones do not fit."""


@dataclass(frozen=True)
class SegmentErrors:
    """The segments of one trajectory, S in all (S may be 0); every field has shape (S,).

    Attributes:
        start: first frame.
        end: last frame.
        length: nominal length in metres.
        t_err: distance between the ends as a ratio of the nominal length.
        r_err: angle between the ends, in radians per metre of nominal length.
    """

    start: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]
    length: FloatArray
    t_err: FloatArray
    r_err: FloatArray


@dataclass(frozen=True)
class LengthDrift:
    """Means over the segments (one at least) of one length."""

    segments: int
    t_err: float
    r_err_deg_per_m: float


@dataclass(frozen=True)
class Drift:
    """Means over all segments; None where there is no segment, which is not a score of 0.

    Attributes:
        t_err: mean translational error as a ratio (0.02 is 2 %).
        r_err_deg_per_m: mean rotational error in degrees a metre.
        t_rmse: root of the mean squared translational error over segments, a ratio.
        segments: how many segments there are.
        per_length: the same for each length in metres of which there is a segment.
    """

    t_err: float | None
    r_err_deg_per_m: float | None
    t_rmse: float | None
    segments: int
    per_length: dict[float, LengthDrift]

    def to_dict(self) -> dict[str, Any]:
        """Plain dicts and numbers for JSON; a length becomes a key such as "100" or "0.5"."""
        result = asdict(self)
        result["per_length"] = {f"{length:g}": asdict(part) for length, part in self.per_length.items()}
        return result


def drift(
    truth: npt.ArrayLike,
    estimate: npt.ArrayLike,
    *,
    planar: bool,
    lengths: Sequence[float] = KITTI_LENGTHS,
    step: int = 10,
) -> Drift:
    """Drift of an estimated trajectory against the ground truth (KITTI devkit, Geiger et al. 2012).

    Args:
        truth: ground truth (N, 4, 4), camera frame, metres.
        estimate: estimate of the same frames, (N, 4, 4). It may start anywhere.
        planar: flatten both to the x-z plane first; lengths are then measured in 2D.
        lengths: segment lengths in metres.
        step: frames between the starts of segments.

    Returns:
        The means; with ``segments`` 0 and None for values if the truth is too short.

    Raises:
        InputError: see `segment_errors`.
    """
    return summarise(segment_errors(truth, estimate, lengths, step, planar=planar))


def segment_errors(
    truth: npt.ArrayLike,
    estimate: npt.ArrayLike,
    lengths: Sequence[float] = KITTI_LENGTHS,
    step: int = 10,
    *,
    planar: bool = False,
) -> SegmentErrors:
    """Errors of all segments, by `calcSequenceErrors` of KITTI's devkit (evaluate_odometry.cpp).

    A segment ends at the first frame whose distance along the ground truth is *greater* than the
    start's plus the length. The angle is rounded to single precision as there, so that the numbers are
    the devkit's: angles below some 0.02 degrees read as 0.

    Args:
        truth: ground truth (N, 4, 4), camera frame, metres.
        estimate: estimate of the same frames, (N, 4, 4).
        lengths: segment lengths in metres; repeated ones count once.
        step: frames between the starts of segments.
        planar: flatten both to the x-z plane first; lengths are then measured in 2D.

    Returns:
        The segments, ordered by start and then length.

    Raises:
        InputError: poses of another shape, of unequal number, not finite or without a rotation (the
            frame is named); lengths that are not positive; a step below 1.
    """
    truth, estimate = _check_poses(truth, "ground truth"), _check_poses(estimate, "estimate")
    if len(truth) != len(estimate):
        raise InputError(
            f"the ground truth has {len(truth)} poses but the estimate {len(estimate)}: "
            "both must describe the same frames"
        )
    if planar:
        truth, estimate = flatten(truth), flatten(estimate)
    start, end, length = _find_segments(travelled(truth), _check_lengths(lengths), step)
    delta_truth = np.linalg.inv(truth[start]) @ truth[end]
    # inv(inv(a) b) is written inv(b) a: one inversion less.
    error = np.linalg.inv(estimate[end]) @ estimate[start] @ delta_truth
    t_err = np.linalg.norm(error[:, :3, 3], axis=1) / length
    return SegmentErrors(start, end, length, t_err, _angles(error[:, :3, :3]) / length)


def summarise(errors: SegmentErrors) -> Drift:
    """Means over segments: every segment has the same weight, as in KITTI's devkit."""
    if len(errors.t_err) == 0:
        return Drift(t_err=None, r_err_deg_per_m=None, t_rmse=None, segments=0, per_length={})
    per_length = {}
    for length in np.unique(errors.length):
        of_length = errors.length == length
        per_length[float(length)] = LengthDrift(
            segments=int(of_length.sum()),
            t_err=float(errors.t_err[of_length].mean()),
            r_err_deg_per_m=float(np.degrees(errors.r_err[of_length].mean())),
        )
    return Drift(
        t_err=float(errors.t_err.mean()),
        r_err_deg_per_m=float(np.degrees(errors.r_err.mean())),
        t_rmse=float(np.sqrt(np.mean(errors.t_err**2))),
        segments=len(errors.t_err),
        per_length=per_length,
    )


def travelled(poses: npt.ArrayLike) -> FloatArray:
    """Distance in metres travelled up to each of the poses (N, 4, 4), (N,); the first is 0."""
    positions = np.asarray(poses, dtype=np.float64)[:, :3, 3]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def fitting_lengths(
    truths: Sequence[npt.ArrayLike], lengths: Sequence[float] = KITTI_LENGTHS
) -> tuple[float, ...]:
    """Choose segment lengths that fit into recordings, so that a short one can be scored too.

    Args:
        truths: ground truth (N, 4, 4) of each recording, taken as it is: flatten it first if the
            score is to be planar.
        lengths: the wanted lengths in metres.

    Returns:
        ``lengths`` if at least one segment exists in at least one recording; otherwise the longest
        three (or fewer) of `LADDER` of which a segment exists, ascending.

    Raises:
        InputError: even the shortest length does not fit, or an input is bad (see `segment_errors`).
    """
    wanted = _check_lengths(lengths)
    # The longest segment starts at frame 0, whatever the step.
    path = max((float(travelled(_check_poses(truth, "ground truth"))[-1]) for truth in truths), default=0.0)
    if path > wanted.min():
        return tuple(float(length) for length in lengths)
    short = tuple(length for length in LADDER if length < path)[-3:]
    if not short:
        raise InputError(
            f"no drift can be measured: the longest path is {path:.3g} m, and the shortest segment "
            f"{LADDER[0]} m: give recordings that move"
        )
    return short


def _find_segments(
    distance: FloatArray, lengths: FloatArray, step: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], FloatArray]:
    if step < 1:
        raise InputError(f"step must be at least 1 frame, not {step}")
    start, length = np.meshgrid(np.arange(0, len(distance), step), lengths, indexing="ij")
    end = np.searchsorted(distance, distance[start] + length, side="right")
    found = end < len(distance)
    return start[found], end[found], length[found]


def _angles(rotations: FloatArray) -> FloatArray:
    """Angles (S,) in [0, pi] of rotations (S, 3, 3), rounded to single precision as the devkit does."""
    first, second, third = np.moveaxis(np.diagonal(rotations, axis1=1, axis2=2).astype(np.float32), -1, 0)
    cosine = (0.5 * ((first + second + third).astype(np.float64) - 1)).astype(np.float32)
    return np.arccos(np.clip(cosine, -1, 1)).astype(np.float64)


def _check_lengths(lengths: Sequence[float]) -> FloatArray:
    values = np.unique(np.asarray(lengths, dtype=np.float64))
    if values.size == 0 or not (np.isfinite(values).all() and (values > 0).all()):
        raise InputError(f"segment lengths must be positive numbers of metres, not {list(lengths)}")
    return values


def _check_poses(poses: npt.ArrayLike, what: str) -> FloatArray:
    poses = np.asarray(poses, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
        raise InputError(f"the {what} must be poses of shape (N, 4, 4), not {poses.shape}")
    finite = np.isfinite(poses).all(axis=(1, 2))
    if not finite.all():
        raise InputError(f"the {what} is not finite (nan or inf) at frame {int(np.argmin(finite))}")
    # Rounded text is fine, but a zero or mirrored matrix would be inverted into a meaningless score.
    rotates = np.abs(np.linalg.det(poses[:, :3, :3]) - 1) < 0.1
    if not rotates.all():
        raise InputError(f"the {what} holds no rotation matrix at frame {int(np.argmin(rotates))}")
    return poses
