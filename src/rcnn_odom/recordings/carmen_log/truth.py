"""Where a robot was: the poses of a CARMEN log itself, its wheel odometry, or a reference beside it."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, planar_to_poses, wrap_angle
from rcnn_odom.recordings.carmen_log.lines import LaserLine
from rcnn_odom.recordings.trajectory import read_lines

ENDINGS = (".gz", ".bz2", ".xz", ".zst", ".log", ".clf")
"""What a reference leaves out of the name of its log; packings first."""
REFERENCE_COLUMNS = ("raw_scan_index", "ref_x", "ref_y", "ref_theta")


def laser_on_robot(line: LaserLine) -> FloatArray:
    """Where the laser sits (4, 4) on the robot whose odometry lines like this one have.

    On ROBOTLASER1 lines the odometry is the robot's, on FLASER lines it is taken as the laser's own.
    """
    if line.kind != "ROBOTLASER1":
        return np.eye(4)
    robot, laser = planar_to_poses([line.robot, line.laser])
    mount: FloatArray = np.linalg.inv(robot) @ laser
    return mount


def wheel_odometry(lines: Iterable[LaserLine], mount: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) of the laser by the robot's wheels; ``mount`` as of :func:`laser_on_robot`."""
    return planar_to_poses([line.robot for line in lines]) @ mount


def name_truth(lines: list[LaserLine]) -> list[str]:
    """Words about the log's own poses as a truth."""
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
    """The table that is a log's reference.

    Args:
        reference: the table, or a folder that holds ``NAME_dense_ref.csv``.
        name: of the log.

    Raises:
        InputError: there is none.
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
    """Poses (scans, 4, 4) of a reference, nan where it has none, and notes on them.

    Raises:
        InputError: it cannot be read, or is not about so many scans.
    """
    planar = _read_reference(path, scans)
    poses, unknown = planar_to_poses(planar), np.isnan(planar[:, 0])
    poses[unknown] = np.nan
    return poses, [f"truth: {path.name}", f"{int(unknown.sum())} scans without truth"]


def _read_reference(path: Path, scans: int) -> FloatArray:
    """x, y and heading of every scan, (scans, 3); a row with any nan is nan as a whole."""
    lines = read_lines(path, f"give a table with the columns {', '.join(REFERENCE_COLUMNS)}")
    # Remarks follow some names in parentheses: "raw_scan_index(in ...)".
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
