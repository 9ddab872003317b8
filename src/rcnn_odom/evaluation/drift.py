"""Drift of a trajectory by the rule of KITTI's development kit (Geiger et al. 2012), in numpy.

Segments of given lengths start every few frames. The error of a segment is the difference between the
estimated and the true relative pose of its ends, divided by its length. All poses are camera poses (N, 4, 4)
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
"""Lengths in metres for recordings that are too short for the requested ones."""


@dataclass(frozen=True)
class SegmentErrors:
    """The segments of one trajectory, S in all (S may be 0); every field has shape (S,).

    Attributes:
        start: first frame.
        end: last frame.
        length: nominal length in metres.
        t_err: distance between the ends as a ratio of the nominal length.
        r_err: angle between the ends, in radians per metre of nominal length.

    Example:
        >>> truth = np.tile(np.eye(4), (301, 1, 1))
        >>> truth[:, 2, 3] = np.arange(301.0)  # 300 m straight ahead, 1 m a frame
        >>> errors = segment_errors(truth, truth, lengths=(100.0, 200.0), step=50)
        >>> errors.start.tolist(), errors.length.tolist()  # 0 and 50 have both lengths
        ([0, 0, 50, 50, 100, 150], [100.0, 200.0, 100.0, 200.0, 100.0, 100.0])
    """

    start: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]
    length: FloatArray
    t_err: FloatArray
    r_err: FloatArray


@dataclass(frozen=True)
class LengthDrift:
    """Means over the segments of one length, of which there is at least one.

    Example:
        >>> truth = np.tile(np.eye(4), (151, 1, 1))
        >>> truth[:, 2, 3] = np.arange(151.0)  # 150 m straight ahead, 1 m a frame
        >>> drift(truth, truth, planar=True).per_length
        {100.0: LengthDrift(segments=5, t_err=0.0, r_err_deg_per_m=0.0)}
    """

    segments: int
    t_err: float
    r_err_deg_per_m: float


@dataclass(frozen=True)
class Drift:
    """Means over all segments; None, not 0, where there is no segment.

    Attributes:
        t_err: mean translational error as a ratio (0.02 is 2 %).
        r_err_deg_per_m: mean rotational error in degrees per metre.
        t_rmse: root mean square of the translational error over segments, as a ratio.
        segments: number of segments.
        per_length: the same for each length in metres that has a segment.

    Example:
        >>> short = np.tile(np.eye(4), (50, 1, 1))  # a camera at rest: no segment of 100 m
        >>> score = drift(short, short, planar=True)
        >>> score.t_err is None, score.to_dict()["segments"]
        (True, 0)
    """

    t_err: float | None
    r_err_deg_per_m: float | None
    t_rmse: float | None
    segments: int
    per_length: dict[float, LengthDrift]

    def to_dict(self) -> dict[str, Any]:
        """Plain dicts and numbers for JSON; the lengths become keys such as "100" or "0.5"."""
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
        estimate: estimate of the same frames, (N, 4, 4). Its first pose is arbitrary.
        planar: project both on the x-z plane first; lengths are then measured in 2D.
        lengths: segment lengths in metres.
        step: frames between the starts of segments.

    Returns:
        The means. If the truth is too short, ``segments`` is 0 and the means are None.

    Raises:
        InputError: see `segment_errors`.

    Example:
        >>> truth = np.tile(np.eye(4), (251, 1, 1))
        >>> truth[:, 2, 3] = np.arange(251.0)  # 250 m straight ahead, 1 m a frame
        >>> estimate = truth.copy()
        >>> estimate[:, 2, 3] *= 1.02  # every step is 2 % too long
        >>> score = drift(truth, estimate, planar=True)
        >>> round(score.t_err, 3), score.r_err_deg_per_m
        (0.02, 0.0)
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
    """Errors of all segments, as in `calcSequenceErrors` of KITTI's devkit (evaluate_odometry.cpp).

    A segment ends at the first frame whose distance along the ground truth is *greater* than the
    start's plus the length. Angles are rounded to single precision as in the devkit, so that the results are
    the same: angles below about 0.02 degrees become 0.

    Args:
        truth: ground truth (N, 4, 4), camera frame, metres.
        estimate: estimate of the same frames, (N, 4, 4).
        lengths: segment lengths in metres; repeated ones count once.
        step: frames between the starts of segments.
        planar: project both on the x-z plane first; lengths are then measured in 2D.

    Returns:
        The segments, ordered by start and then length.

    Raises:
        InputError: the poses have another shape, differ in number, are not finite or hold no rotation matrix
            (the message names the frame); a length is not positive; the step is below 1.

    Example:
        >>> truth = np.tile(np.eye(4), (5, 1, 1))
        >>> truth[:, 2, 3] = [0.0, 1.0, 2.0, 3.0, 4.0]  # straight ahead, 1 m a frame
        >>> estimate = truth.copy()
        >>> estimate[4, 0, 3] = 0.3  # the last pose is 0.3 m too far to the right
        >>> errors = segment_errors(truth, estimate, lengths=(1.5,), step=1)
        >>> errors.end.tolist(), errors.t_err.round(3).tolist()  # 0.3 m of 1.5 m
        ([2, 3, 4], [0.0, 0.0, 0.2])
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
    # inv(b) a equals inv(inv(a) b) and needs one inversion less.
    error = np.linalg.inv(estimate[end]) @ estimate[start] @ delta_truth
    t_err = np.linalg.norm(error[:, :3, 3], axis=1) / length
    return SegmentErrors(start, end, length, t_err, _angles(error[:, :3, :3]) / length)


def summarise(errors: SegmentErrors) -> Drift:
    """Means over segments, each with the same weight, as in KITTI's devkit.

    Example:
        >>> start, end, length = np.array([0, 10]), np.array([101, 111]), np.array([100.0, 100.0])
        >>> errors = SegmentErrors(start, end, length, np.array([0.01, 0.03]), np.zeros(2))
        >>> score = summarise(errors)
        >>> round(score.t_err, 6), score.segments
        (0.02, 2)
    """
    if len(errors.t_err) == 0:
        return Drift(t_err=None, r_err_deg_per_m=None, t_rmse=None, segments=0, per_length={})
    per_length = {}
    for length in np.unique(errors.length):
        selected = errors.length == length
        per_length[float(length)] = LengthDrift(
            segments=int(selected.sum()),
            t_err=float(errors.t_err[selected].mean()),
            r_err_deg_per_m=float(np.degrees(errors.r_err[selected].mean())),
        )
    return Drift(
        t_err=float(errors.t_err.mean()),
        r_err_deg_per_m=float(np.degrees(errors.r_err.mean())),
        t_rmse=float(np.sqrt(np.mean(errors.t_err**2))),
        segments=len(errors.t_err),
        per_length=per_length,
    )


def travelled(poses: npt.ArrayLike) -> FloatArray:
    """Distance in metres travelled up to each of the poses (N, 4, 4): (N,), the first is 0.

    Example:
        >>> poses = np.tile(np.eye(4), (3, 1, 1))
        >>> poses[1:, 2, 3] = 3.0  # 3 m ahead ...
        >>> poses[2, 0, 3] = 4.0  # ... and then 4 m to the right
        >>> travelled(poses)
        array([0., 3., 7.])
    """
    positions = np.asarray(poses, dtype=np.float64)[:, :3, 3]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def fitting_lengths(
    truths: Sequence[npt.ArrayLike], lengths: Sequence[float] = KITTI_LENGTHS
) -> tuple[float, ...]:
    """Chooses segment lengths that fit into the recordings, so that short ones can be scored too.

    Args:
        truths: ground truth (N, 4, 4) of each recording, used as it is: project it on a plane first if the
            score is to be planar.
        lengths: the requested lengths in metres.

    Returns:
        ``lengths`` if at least one segment exists in at least one recording; otherwise, in ascending order,
        the three longest lengths of `LADDER` for which a segment exists, or fewer.

    Raises:
        InputError: not even the shortest length fits, or an input is invalid (see `segment_errors`).

    Example:
        >>> truth = np.tile(np.eye(4), (31, 1, 1))
        >>> truth[:, 2, 3] = np.arange(31.0)  # 30 m straight ahead: too short for 100 m
        >>> fitting_lengths([truth])
        (5.0, 10.0, 20.0)
    """
    wanted = _check_lengths(lengths)
    # The longest segment starts at frame 0 for every step.
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
    """First frames, last frames and nominal lengths, each (S,), for distances (N,) along the path."""
    if step < 1:
        raise InputError(f"step must be at least 1 frame, not {step}")
    start, length = np.meshgrid(np.arange(0, len(distance), step), lengths, indexing="ij")
    end = np.searchsorted(distance, distance[start] + length, side="right")
    found = end < len(distance)
    return start[found], end[found], length[found]


def _angles(rotations: FloatArray) -> FloatArray:
    """Angles (S,) in [0, pi] of rotations (S, 3, 3), rounded to single precision as in the devkit."""
    first, second, third = np.moveaxis(np.diagonal(rotations, axis1=1, axis2=2).astype(np.float32), -1, 0)
    cosine = (0.5 * ((first + second + third).astype(np.float64) - 1)).astype(np.float32)
    return np.arccos(np.clip(cosine, -1, 1)).astype(np.float64)


def _check_lengths(lengths: Sequence[float]) -> FloatArray:
    values = np.unique(np.asarray(lengths, dtype=np.float64))
    if values.size == 0 or not (np.isfinite(values).all() and (values > 0).all()):
        raise InputError(f"segment lengths must be positive numbers of metres, not {list(lengths)}")
    return values


def _check_poses(poses: npt.ArrayLike, name: str) -> FloatArray:
    poses = np.asarray(poses, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
        raise InputError(f"the {name} must be poses of shape (N, 4, 4), not {poses.shape}")
    finite = np.isfinite(poses).all(axis=(1, 2))
    if not finite.all():
        raise InputError(f"the {name} is not finite (nan or inf) at frame {int(np.argmin(finite))}")
    # Rounded numbers are accepted, but the inverse of a zero or mirrored matrix gives a meaningless score.
    rotates = np.abs(np.linalg.det(poses[:, :3, :3]) - 1) < 0.1
    if not rotates.all():
        raise InputError(f"the {name} holds no rotation matrix at frame {int(np.argmin(rotates))}")
    return poses
