"""Scores a trajectory against hand-verified relations between scans; no global ground truth is needed.

Kuemmerle, Steder, Dornhege, Ruhnke, Grisetti, Stachniss and Kleiner, "On Measuring the Accuracy of SLAM
Algorithms", Autonomous Robots 27, 2009.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, planar_to_poses
from rcnn_odom.recordings.trajectory import read_numbers

LOOP_PATH = 5.0
"""A relation closes a loop if the robot drove more metres than this between its scans; otherwise it is
sequential. On ``aces`` and ``intel`` of the benchmark, sequential relations span at most 0.6 m and loops at
least 10 m."""


@dataclass(frozen=True, eq=False)
class Relations:
    """Verified relative poses between pairs of scans.

    Attributes:
        times: (R, 2) stamps of the two scans in whole microseconds, see :func:`stamp_keys`.
        steps: (R, 3) pose of the second scan in the frame of the first: x and y in metres, heading in
            radians.

    Example:
        >>> Relations(stamp_keys([[0.5, 1.5]]), np.array([[1.0, 0.0, 0.0]])).times
        array([[ 500000, 1500000]])
    """

    times: npt.NDArray[np.int64]
    steps: FloatArray


def stamp_keys(seconds: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Rounds stamps to whole microseconds, as text files do, so that equal stamps compare equal.

    Args:
        seconds: stamps of any shape.

    Returns:
        Whole microseconds of the same shape.

    Example:
        >>> stamp_keys([976052905.1673030, 0.25]).tolist()
        [976052905167303, 250000]
    """
    return np.round(np.asarray(seconds, dtype=np.float64) * 1e6).astype(np.int64)


def read_relations(path: str | Path) -> Relations:
    """Reads lines of ``t1 t2 x y z roll pitch yaw`` in seconds, metres and radians; keeps x, y and yaw.

    Raises:
        InputError: the file cannot be read or is empty, or a line (its number is in the message) does not
            contain eight finite numbers.

    Example:
        >>> from tempfile import NamedTemporaryFile
        >>> with NamedTemporaryFile("w+", suffix=".relations") as file:
        ...     _ = file.write("0.5 1.5 1.0 0.0 0.0 0.0 0.0 0.1")
        ...     file.flush()
        ...     relations = read_relations(file.name)
        >>> relations.steps
        array([[1. , 0. , 0.1]])
    """
    rows = read_numbers(path, 8, "a relation has 8 numbers, t1 t2 x y z roll pitch yaw")
    return Relations(stamp_keys(rows[:, :2]), rows[:, [2, 3, 7]])


def find_scans(relations: Relations, stamps: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Finds the scans of each relation by their stamps.

    Args:
        relations: R relations.
        stamps: (N,) stamps of all scans, see :func:`stamp_keys`; their order does not matter.

    Returns:
        Indices (R, 2) of the two scans of each relation; -1 if no scan has the stamp.

    Raises:
        InputError: several scans have a stamp of a relation.

    Example:
        >>> relations = Relations(stamp_keys([[1.0, 2.0], [2.0, 9.0]]), np.zeros((2, 3)))
        >>> find_scans(relations, stamp_keys([0.0, 1.0, 2.0])).tolist()
        [[1, 2], [2, -1]]
    """
    order = np.argsort(stamps, kind="stable")
    ordered = stamps[order]
    first, last = (np.searchsorted(ordered, relations.times, side) for side in ("left", "right"))
    if (last - first > 1).any():
        time = relations.times[last - first > 1][0] / 1e6
        raise InputError(
            f"{time:.6f} s is the stamp of several scans, and a relation refers to it; give a log "
            "whose stamps are unique"
        )
    return np.where(last > first, order[np.minimum(first, len(order) - 1)], -1)


def score_relations(
    relations: Relations,
    stamps: npt.NDArray[np.int64],
    driven: FloatArray,
    poses: FloatArray,
    loop_path: float = LOOP_PATH,
) -> dict[str, Any]:
    """Errors of a trajectory against sequential relations, against loop closures, and against all relations.

    Args:
        relations: the verified relations.
        stamps: (N,) stamps of all scans of the log, see :func:`stamp_keys`.
        driven: (N,) path length in metres up to each scan, which separates loops from sequential relations.
        poses: estimated laser poses (N, 4, 4), nan if a scan has no estimate.
        loop_path: a relation closes a loop if more metres than this were driven between its scans.

    Returns:
        ``sequential``, ``loop`` and ``all`` (see :func:`summarise`); ``not_in_log`` and ``not_in_estimate``,
        the numbers of relations that were left out because a scan or its estimate is missing.

    Raises:
        InputError: no relation is left, or several scans have a stamp of a relation.

    Example:
        >>> relations = Relations(stamp_keys([[0.0, 1.0]]), np.array([[1.0, 0.0, 0.0]]))
        >>> poses = planar_to_poses([[0.0, 0.0, 0.0], [1.1, 0.0, 0.0]])  # 0.1 m too far
        >>> report = score_relations(relations, stamp_keys([0.0, 1.0]), np.array([0.0, 1.0]), poses)
        >>> report["sequential"]["count"], round(report["sequential"]["translation_mean_m"], 3)
        (1, 0.1)
    """
    scans = find_scans(relations, stamps)
    in_log = (scans >= 0).all(1)
    if not in_log.any():
        raise InputError(
            f"the log has the scans of none of the {len(scans)} relations; give the relations of this log"
        )
    known = in_log & np.isfinite(poses[scans]).all((1, 2, 3))
    if not known.any():
        raise InputError(
            "the estimate has no pose for the scans of any relation; score a longer part of the log"
        )
    errors = relation_errors(poses, scans[known], relations.steps[known])
    first, second = driven[scans[known]].T
    loop = np.abs(second - first) > loop_path
    groups = {"sequential": errors[~loop], "loop": errors[loop], "all": errors}
    left_out = {"not_in_log": int((~in_log).sum()), "not_in_estimate": int((in_log & ~known).sum())}
    return {**{name: summarise(group) for name, group in groups.items()}, **left_out}


def relation_errors(poses: FloatArray, scans: npt.NDArray[np.int64], steps: FloatArray) -> FloatArray:
    """Absolute errors of a trajectory against relations.

    Args:
        poses: laser poses (N, 4, 4), x forward and y left.
        scans: (R, 2) indices of the two poses of each relation.
        steps: (R, 3) verified relative poses, x and y in metres and heading in radians.

    Returns:
        Errors (R, 2) in metres and radians, 0 or more.

    Example:
        >>> poses = planar_to_poses([[0.0, 0.0, 0.0], [1.0, 0.3, 0.1]])
        >>> relation_errors(poses, np.array([[0, 1]]), np.array([[1.0, 0.0, 0.0]])).round(3)
        array([[0.3, 0.1]])
    """
    estimated = np.linalg.inv(poses[scans[:, 0]]) @ poses[scans[:, 1]]
    error = np.linalg.inv(planar_to_poses(steps)) @ estimated
    turn = np.arctan2(error[:, 1, 0], error[:, 0, 0])
    return np.stack([np.hypot(error[:, 0, 3], error[:, 1, 3]), np.abs(turn)], axis=1)


def summarise(errors: FloatArray) -> dict[str, Any]:
    """Number, mean and median of errors (R, 2) in metres and radians.

    Returns:
        ``count``; and, if it is not 0, ``translation_mean_m``, ``translation_median_m``,
        ``rotation_mean_deg`` and ``rotation_median_deg``.

    Example:
        >>> summarise(np.array([[0.1, 0.0], [0.3, 0.0]]))["translation_mean_m"]
        0.2
        >>> summarise(np.empty((0, 2)))
        {'count': 0}
    """
    report: dict[str, Any] = {"count": len(errors)}
    if len(errors):
        for name, values in (
            ("translation_{}_m", errors[:, 0]),
            ("rotation_{}_deg", np.rad2deg(errors[:, 1])),
        ):
            report[name.format("mean")] = float(values.mean())
            report[name.format("median")] = float(np.median(values))
    return report
