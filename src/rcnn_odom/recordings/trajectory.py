"""Reads and writes trajectories in KITTI's and TUM's text formats, and motions as CSV.

Poses are (N, 4, 4) from the camera's frame (x right, y down, z forward) to a fixed frame.
"""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TextIO

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.packing import HEAD, refuse_pointer
from rcnn_odom.recordings.text import refuse_utf16


def file_name(sequence: str) -> str:
    """Turn the name of a sequence into a file name.

    >>> file_name("c[0.5:]")
    'c_0.5-'
    """
    return re.sub(r"[^\w.-]+", "_", sequence.replace(":", "-")).strip("_")


def read_kitti(path: str | Path) -> FloatArray:
    """Read a KITTI trajectory: a line for each frame with the upper 3x4 part of the pose, row by row.

    Args:
        path: text file of 12 numbers a line; blank lines are allowed only at the end.

    Returns:
        Poses (N, 4, 4), N >= 1, translations in metres.

    Raises:
        InputError: the file cannot be read or is empty, or a line (named in the message) does not hold
            12 finite numbers with a rotation among them.
    """
    lines = read_lines(path, "give a file with 12 numbers a line, one line a frame")
    rows = [
        parse_numbers(f"{path}:{number}", line.split(), 12, "a KITTI pose has 12 finite numbers")
        for number, line in enumerate(lines, start=1)
    ]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = np.reshape(rows, (-1, 3, 4))
    for number, pose in enumerate(poses, start=1):
        if not is_rotation(pose[:3, :3]):
            raise InputError(
                f"{path}:{number}: the 3x3 part of a pose must be a rotation, and this one is not; correct "
                "the line"
            )
    return poses


def read_lines(path: str | Path, wanted: str) -> list[str]:
    """Read the lines of a text file, at least one.

    Args:
        path: path of the file.
        wanted: advice for the error message.

    Raises:
        InputError: the file cannot be read, is empty, is text in UTF-16 or UTF-32, or is a Git LFS pointer.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}; {wanted}") from error
    refuse_pointer(path, content[:HEAD])
    refuse_utf16(path, content[:HEAD])
    lines = content.decode("utf-8-sig", errors="replace").rstrip().splitlines()
    if not lines:
        raise InputError(f"{path}: is empty; {wanted}")
    return lines


def parse_numbers(where: str, words: list[str], count: int, wanted: str) -> list[float]:
    """Convert the words of a line to finite numbers.

    Args:
        where: file and line, for the error message.
        words: words of the line.
        count: required number of words.
        wanted: a sentence that says what the line must hold, for the error message.

    Raises:
        InputError: a word is not a finite number, or there is another number of words.

    >>> parse_numbers("file:1", ["1", "2.5"], 2, "a line has 2 numbers")
    [1.0, 2.5]
    """
    try:
        if len(words) != count:
            raise ValueError(f"found {len(words)} fields")
        values = [float(word) for word in words]
        if not np.isfinite(values).all():
            raise ValueError("found nan or inf")
    except ValueError as error:
        raise InputError(f"{where}: {error}, but {wanted}; correct the line") from error
    return values


def is_rotation(matrix: FloatArray) -> bool:
    """Whether a matrix (3, 3) of finite numbers is a rotation, within a tolerance of 0.01."""
    # Large numbers are excluded first, because their determinant would overflow.
    return bool((np.abs(matrix) < 1.01).all()) and abs(np.linalg.det(matrix) - 1) < 0.01


def read_tum(path: str | Path) -> tuple[FloatArray, FloatArray]:
    """Read lines of ``stamp x y z qx qy qz qw``, as :func:`write_tum` writes them; # begins a comment.

    Returns:
        Stamps (N,) in seconds and poses (N, 4, 4).

    Raises:
        InputError: the file cannot be read or is empty, or a line (named in the message) does not hold eight
            finite numbers with a quaternion of unit length among them.
    """
    from scipy.spatial.transform import Rotation

    rows = read_numbers(path, 8, "a TUM pose has 8 numbers, stamp x y z qx qy qz qw")
    strange = np.flatnonzero(np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) > 0.01)
    if len(strange):
        raise InputError(
            f"{path}: the pose of {rows[strange[0], 0]:.6f} s has no unit quaternion as its last four "
            "numbers; correct it"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    return rows[:, 0], poses


def read_numbers(path: str | Path, columns: int, wanted: str) -> FloatArray:
    """Read a table of numbers from a text file; lines that begin with # are comments.

    Args:
        path: path of the text file.
        columns: number of columns.
        wanted: what a line must hold, for the error message.

    Returns:
        Rows (N, columns), N >= 1.

    Raises:
        InputError: the file cannot be read or holds no row, or a line (named in the message) does not hold
            ``columns`` finite numbers.
    """
    rows = [
        parse_numbers(f"{path}:{number}", line.split(), columns, wanted)
        for number, line in enumerate(read_lines(path, wanted), start=1)
        if not line.startswith("#")
    ]
    if not rows:
        raise InputError(f"{path}: has only comments; {wanted}")
    return np.array(rows)


def write_kitti(path: str | Path | TextIO, poses: npt.ArrayLike) -> None:
    """Write poses in KITTI's format, in full precision: `read_kitti` returns the same numbers.

    Rounding could change the drift: at a constant speed, a distance may equal a segment's length exactly, and
    then the last digit decides where the segment ends.

    Args:
        path: text file to write, or an open file to which the lines are appended.
        poses: (N, 4, 4), translations in metres.

    Raises:
        ValueError: ``poses`` has another shape.
    """
    poses = _check_shape(poses)
    np.savetxt(path, poses[:, :3].reshape(-1, 12), fmt="%.16e")


def write_tum(path: str | Path | TextIO, stamps: npt.ArrayLike, poses: npt.ArrayLike) -> None:
    """Write lines of ``stamp x y z qx qy qz qw``, the format of the TUM RGB-D benchmark.

    Args:
        path: text file to write, or an open file to which the lines are appended.
        stamps: times (N,) in seconds.
        poses: (N, 4, 4), translations in metres. They are not transformed: camera poses stay camera poses.

    Raises:
        ValueError: the shapes do not fit each other.
    """
    poses = _check_shape(poses)
    stamps = np.asarray(stamps, dtype=np.float64)
    if stamps.shape != (len(poses),):
        raise ValueError(f"stamps have shape {stamps.shape}, but there are {len(poses)} poses")
    rows = np.column_stack([stamps, poses[:, :3, 3], _quaternions(poses[:, :3, :3])])
    np.savetxt(path, rows, fmt=["%.9f"] + ["%.9e"] * 7)


def _quaternions(rotations: FloatArray) -> FloatArray:
    """Unit quaternions (N, 4) in the order x, y, z, w with w >= 0, of rotations (N, 3, 3).

    Method of Bar-Itzhack (2000): the eigenvector of the largest eigenvalue. Unlike the formula that divides
    by the trace, it is stable at half turns, and tolerates rounded matrices.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(rotations, 0, -1)
    rows = [
        [xx - yy - zz, yx + xy, zx + xz, zy - yz],
        [yx + xy, yy - xx - zz, zy + yz, xz - zx],
        [zx + xz, zy + yz, zz - xx - yy, yx - xy],
        [zy - yz, xz - zx, yx - xy, xx + yy + zz],
    ]
    quaternions: FloatArray = np.linalg.eigh(np.moveaxis(np.array(rows), -1, 0))[1][:, :, -1]
    return np.where(quaternions[:, 3:] < 0, -quaternions, quaternions)


def flatten(poses: npt.ArrayLike) -> FloatArray:
    """Project camera poses onto the x-z plane: x, z and the heading about y remain.

    The heading is the direction of the forward axis (third column) in the plane; height, pitch and
    roll are dropped.

    Args:
        poses: (N, 4, 4), in the camera's frame.

    Returns:
        Planar poses (N, 4, 4) with y = 0 and rotations only about y.

    Raises:
        ValueError: ``poses`` has another shape.

    >>> flatten(np.eye(4)[None]).shape
    (1, 4, 4)
    """
    poses = _check_shape(poses)
    heading = np.arctan2(poses[:, 0, 2], poses[:, 2, 2])
    flat = np.tile(np.eye(4), (len(poses), 1, 1))
    flat[:, 0, 0] = flat[:, 2, 2] = np.cos(heading)
    flat[:, 0, 2] = np.sin(heading)
    flat[:, 2, 0] = -flat[:, 0, 2]
    flat[:, 0, 3], flat[:, 2, 3] = poses[:, 0, 3], poses[:, 2, 3]
    return flat


def _check_shape(poses: npt.ArrayLike) -> FloatArray:
    poses = np.asarray(poses, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise ValueError(f"poses must have shape (N, 4, 4), not {poses.shape}")
    return poses


def write_motions(
    path: str | Path, motions: FloatArray, truth: FloatArray, baselines: Mapping[str, FloatArray]
) -> None:
    """Write a CSV file with a line for each motion, in full precision; ``frame`` is that of its later scan.

    Args:
        path: file to write.
        motions: (N, 2) estimated distances in metres and heading changes in radians.
        truth: (N, 2) true ones.
        baselines: (N, 2) those of other methods, by the name of the method, which begins the column names.
    """
    rows = np.column_stack([np.arange(1, len(truth) + 1), motions, truth, *baselines.values()])
    formats = ["%d"] + ["%.17g"] * (rows.shape[1] - 1)
    header = ",".join(_motion_columns(baselines))
    np.savetxt(path, rows, fmt=formats, delimiter=",", header=header, comments="")


def _motion_columns(baselines: Iterable[str]) -> list[str]:
    prefixes = ["", "true_", *(f"{name}_" for name in baselines)]
    return ["frame", *(prefix + unit for prefix in prefixes for unit in ("distance_m", "heading_rad"))]


def read_motions(path: str | Path) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Read a file of :func:`write_motions`.

    Returns:
        The truth (N, 2), N >= 1, and motions (N, 2) by method; the first method is ``estimate``.

    Raises:
        InputError: the file cannot be read, has another header or no motion, or a line (named in the message)
            is not the next frame with a finite number in each column.
    """
    lines = read_lines(path, "give a file of motions, as evaluate.py writes them")
    header = lines[0].split(",")
    baselines = [name.removesuffix("_distance_m") for name in header[5::2]]
    methods = ["estimate", "true", *baselines]
    if header != _motion_columns(baselines) or len(set(methods)) < len(methods):
        raise InputError(
            f"{path}:1: the header must be {','.join(_motion_columns([]))}, then "
            "METHOD_distance_m,METHOD_heading_rad for each other method"
        )
    if len(lines) == 1:
        raise InputError(f"{path}: has no motion under its header: give a file with one line a frame")
    rows = [_parse_motions(line, frame, len(header), path) for frame, line in enumerate(lines[1:], start=1)]
    columns = dict(zip(methods, np.split(np.array(rows), len(methods), axis=1), strict=True))
    return columns.pop("true"), columns


def _parse_motions(line: str, frame: int, columns: int, path: str | Path) -> list[float]:
    where, fields = f"{path}:{frame + 1}", line.split(",")
    number, *motions = parse_numbers(where, fields, columns, f"a line has {columns} finite numbers here")
    if number != frame:
        raise InputError(f"{where}: frame {fields[0]} in place of {frame}: frames count 1, 2, 3, ...")
    return motions
