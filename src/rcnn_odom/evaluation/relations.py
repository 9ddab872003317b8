"""Trajectories against relations between single scans that people have verified, without a global truth.

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
"""Metres driven between two scans, from which on their relation closes a loop. The others follow the robot
from one place to the next: on the benchmark's ``aces`` and ``intel`` they span at most 0.6 m, and loops
10 m and more."""


@dataclass(frozen=True, eq=False)
class Relations:
    """Relative poses between pairs of scans.

    Attributes:
        times: (R, 2) stamps of the earlier and the later scan as :func:`stamp_keys` gives them.
        steps: (R, 3) x and y in metres and heading in radians of the later in the earlier scan's frame.
    """

    times: npt.NDArray[np.int64]
    steps: FloatArray


def stamp_keys(seconds: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Stamps in whole microseconds, (N,), to be compared: text files round them there."""
    return np.round(np.asarray(seconds, dtype=np.float64) * 1e6).astype(np.int64)


def read_relations(path: str | Path) -> Relations:
    """Read lines of ``t1 t2 x y z roll pitch yaw``: seconds, metres and radians; only x, y and yaw are kept.

    Raises:
        InputError: the file cannot be read or is empty, or a line (which is named) does not hold eight
            finite numbers.
    """
    rows = read_numbers(path, 8, "a relation has 8 numbers, t1 t2 x y z roll pitch yaw")
    return Relations(stamp_keys(rows[:, :2]), rows[:, [2, 3, 7]])


def find_scans(relations: Relations, stamps: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Numbers (R, 2) of the scans with a relation's times among the stamps (N,); -1 where there is none.

    Raises:
        InputError: several scans have one of these stamps.
    """
    order = np.argsort(stamps, kind="stable")
    ordered = stamps[order]
    first, last = (np.searchsorted(ordered, relations.times, side) for side in ("left", "right"))
    if (last - first > 1).any():
        time = relations.times[last - first > 1][0] / 1e6
        raise InputError(
            f"{time:.6f} s is the stamp of several scans, and the relations name it; give a log "
            "whose stamps differ"
        )
    return np.where(last > first, order[np.minimum(first, len(order) - 1)], -1)


def score_relations(
    relations: Relations,
    stamps: npt.NDArray[np.int64],
    driven: FloatArray,
    poses: FloatArray,
    loop_path: float = LOOP_PATH,
) -> dict[str, Any]:
    """Errors against sequential relations, against loops, and against all of them.

    Args:
        relations: verified by people.
        stamps: (N,) of all scans of the log, see :func:`stamp_keys`.
        driven: (N,) metres along the log's way, by which loops are known from sequential relations.
        poses: estimated laser poses (N, 4, 4), nan where there is none.
        loop_path: metres driven from which on a relation closes a loop.

    Returns:
        ``sequential``, ``loop`` and ``all`` (see :func:`summarise`), and how many relations are left out:
        ``not_in_log`` and ``not_in_estimate``.

    Raises:
        InputError: none is left, or several scans have a stamp that relations name.
    """
    scans = find_scans(relations, stamps)
    in_log = (scans >= 0).all(1)
    if not in_log.any():
        raise InputError(f"none of the {len(scans)} relations has its times in the log; give the log's own")
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
    """Errors (R, 2), metres and radians, not negative, of a trajectory against relations.

    Args:
        poses: laser poses (N, 4, 4), x forward and y left.
        scans: (R, 2) rows of them.
        steps: (R, 3) verified x and y in metres and heading in radians.
    """
    estimated = np.linalg.inv(poses[scans[:, 0]]) @ poses[scans[:, 1]]
    error = np.linalg.inv(planar_to_poses(steps)) @ estimated
    turn = np.arctan2(error[:, 1, 0], error[:, 0, 0])
    return np.stack([np.hypot(error[:, 0, 3], error[:, 1, 3]), np.abs(turn)], axis=1)


def summarise(errors: FloatArray) -> dict[str, Any]:
    """Count, mean and median of errors (R, 2) in metres and radians; no relation has none."""
    report: dict[str, Any] = {"count": len(errors)}
    if len(errors):
        for name, values in (
            ("translation_{}_m", errors[:, 0]),
            ("rotation_{}_deg", np.rad2deg(errors[:, 1])),
        ):
            report[name.format("mean")] = float(values.mean())
            report[name.format("median")] = float(np.median(values))
    return report
