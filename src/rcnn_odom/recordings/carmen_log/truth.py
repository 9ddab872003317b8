"""True poses of a robot from a CARMEN log or from a reference file, and the log's wheel odometry."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, planar_to_poses, wrap_angle
from rcnn_odom.recordings.carmen_log.lines import LaserLine
from rcnn_odom.recordings.trajectory import read_lines

ENDINGS = (".gz", ".bz2", ".xz", ".zst", ".log", ".clf")
"""Suffixes of a log's name that are not part of its reference's name, compressions first."""
REFERENCE_COLUMNS = ("raw_scan_index", "ref_x", "ref_y", "ref_theta")


def laser_on_robot(line: LaserLine) -> FloatArray:
    """Pose (4, 4) of the laser in the frame of the log's odometry, from one line of the log.

    On ROBOTLASER1 lines, the odometry is the robot's. On FLASER lines, it is taken to be the laser's own.
    """
    if line.kind != "ROBOTLASER1":
        return np.eye(4)
    robot, laser = planar_to_poses([line.robot, line.laser])
    mount: FloatArray = np.linalg.inv(robot) @ laser
    return mount


def wheel_odometry(lines: Iterable[LaserLine], mount: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) of the laser from wheel odometry; ``mount`` is the result of :func:`laser_on_robot`."""
    return planar_to_poses([line.robot for line in lines]) @ mount


def describe_truth(lines: list[LaserLine]) -> list[str]:
    """Notes about the log's own poses as truth: a warning if they equal the wheel odometry."""
    difference = np.array([line.laser for line in lines]) - np.array([line.robot for line in lines])
    difference[:, 2] = wrap_angle(difference[:, 2])
    truth = "truth: the log's laser pose"
    if np.abs(difference).max() >= 1e-6:
        return [truth]
    warning = (
        "the log's laser pose equals its odometry everywhere: unless the log was corrected, the truth is "
        "just the wheel odometry"
    )
    return [truth, warning]


def find_reference(reference: Path, name: str) -> Path:
    """Find the table with a log's reference.

    Args:
        reference: the table, or a folder that holds ``NAME_dense_ref.csv``.
        name: name of the log.

    Raises:
        InputError: there is no such table.
    """
    if reference.is_dir():
        stem = name
        for suffix in ENDINGS:
            stem = stem.removesuffix(suffix)
        reference = reference / f"{stem}_dense_ref.csv"
    if not reference.is_file():
        raise InputError(
            f"{reference}: no such file; set data.reference to a table or its folder, or leave it out"
        )
    return reference


def read_truth(path: Path, scans: int) -> tuple[FloatArray, list[str]]:
    """Read a reference: poses (scans, 4, 4), nan where the truth is unknown, and notes about them.

    Args:
        path: path of the table.
        scans: number of scans of the log.

    Raises:
        InputError: the table cannot be read, or has another number of rows than the log has scans.
    """
    planar = _read_reference(path, scans)
    poses, unknown = planar_to_poses(planar), np.isnan(planar[:, 0])
    poses[unknown] = np.nan
    return poses, [f"truth: {path.name}", f"{int(unknown.sum())} scans without truth"]


def _read_reference(path: Path, scans: int) -> FloatArray:
    """x, y and heading of every scan, (scans, 3); a row that contains a nan becomes nan as a whole."""
    lines = read_lines(path, f"give a table with the columns {', '.join(REFERENCE_COLUMNS)}")
    # Some column names are followed by a remark in parentheses: "raw_scan_index(in ...)".
    header = [word.split("(")[0].strip() for word in lines[0].lstrip("# ").split(",")]
    missing = [column for column in REFERENCE_COLUMNS if column not in header]
    if missing:
        raise InputError(f"{path}:1: the header has no column {', '.join(missing)}; name the columns there")
    columns = [header.index(column) for column in REFERENCE_COLUMNS]
    truth = np.full((len(lines) - 1, 3), np.nan)
    for row, text in enumerate(lines[1:]):
        words = text.split(",")
        try:
            index, *pose = (float(words[column]) for column in columns)
        except (IndexError, ValueError) as error:
            raise InputError(f"{path}:{row + 2}: not a row of numbers ({error}); correct it") from error
        if index != row or np.isinf(pose).any():
            raise InputError(
                f"{path}:{row + 2}: expected raw_scan_index {row} and a pose that is finite or nan, got "
                f"'{text.strip()[:60]}'; correct it"
            )
        truth[row] = np.nan if np.isnan(pose).any() else pose
    if len(truth) != scans:
        raise InputError(
            f"{path}: {len(truth)} rows, but the log has {scans} scans; use the log's own reference"
        )
    return truth
