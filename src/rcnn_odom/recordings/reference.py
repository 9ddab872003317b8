"""Reads the true poses of a recording from a trajectory file, matched by stamp or by line."""

import re
from pathlib import Path

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, change_frame, planar_to_poses, poses_to_planar, wrap_angle
from rcnn_odom.recordings.trajectory import file_name, read_kitti, read_tum

MATCHER = "matcher"
"""``data.reference=matcher``: readers give poses of nan, and training fills in the poses of scan matching."""
FARTHEST_IN_TIME = 0.5
"""Seconds; largest time between a scan and the poses that it is interpolated from."""
ENDINGS = r"\.(gz|bz2|xz|zstd?|bag|active|mcap|db3|log|clf|jsonl?|txt)$"
"""Endings of a recording's name that are not part of its trajectory's name."""


def find_trajectory(reference: Path, name: str, has_clock: bool) -> Path:
    """Find the trajectory file of a recording.

    Args:
        reference: the file; or a folder with ``NAME.tum`` or ``NAME.txt``, or with the folder ``NAME`` that
            ``rcnn-odom run --out`` wrote. NAME is the name of the recording, with or without its endings.
        name: name of the recording.
        has_clock: whether the scans have stamps. If so, ``.tum`` is preferred, otherwise ``.txt``, which
            has a line for each scan.

    Raises:
        InputError: there is no such file.
    """
    if reference.is_file():
        return reference
    kinds = (".tum", ".txt") if has_clock else (".txt", ".tum")
    names = dict.fromkeys((file_name(name), Path(name).name, strip_endings(name)))
    for each in names:
        for kind in kinds:
            for path in (reference / f"{each}{kind}", reference / each / f"trajectory{kind}"):
                if path.is_file():
                    return path
    wanted = strip_endings(name)
    raise InputError(
        f"{reference}: no trajectory of {name} in it; put {wanted}.tum or {wanted}.txt there, or set "
        "data.reference=matcher"
    )


def strip_endings(name: str) -> str:
    """Remove folders and endings from a recording's name.

    >>> strip_endings("logs/a.bag.gz")
    'a'
    """
    name = Path(name).name
    while (shorter := re.sub(ENDINGS, "", name)) not in (name, ""):
        name = shorter
    return name


def read_reference(
    path: Path, stamps: FloatArray, has_clock: bool, camera_from_laser: FloatArray
) -> tuple[FloatArray, list[str]]:
    """Read the laser's poses at the times of the scans.

    Args:
        path: trajectory in TUM's format (``.tum``), whose poses are found by stamp; or in KITTI's format,
            with a line for each scan.
        stamps: (N,) seconds, stamps of the scans.
        has_clock: whether the stamps are trusted; used for the error message.
        camera_from_laser: (4, 4), to the frame in which this project writes trajectories.

    Returns:
        Poses (N, 4, 4), nan if the file has no pose near in time; and notes about them.

    Raises:
        InputError: the file cannot be read, or does not belong to these scans.
    """
    if path.suffix == ".tum":
        times, found = read_tum(path)
        times, first = np.unique(times, return_index=True)
        found, frame_note = in_laser_frame(found[first], camera_from_laser)
        poses = _interpolate(found, times, stamps)
    else:
        found, frame_note = in_laser_frame(read_kitti(path), camera_from_laser)
        if len(found) != len(stamps):
            raise InputError(
                f"{path}: {len(found)} poses, but the recording has {len(stamps)} scans; give one pose a "
                "scan, or a .tum file, whose poses are found by their stamps"
            )
        poses = found
    unknown = int(np.isnan(poses[:, 0, 0]).sum())
    if unknown > len(poses) - 2:
        clock = "" if has_clock else ", whose stamps are not trusted"
        raise InputError(
            f"{path}: has no poses near the stamps of the recording{clock}, {stamps.min():.3f} to "
            f"{stamps.max():.3f} s; give its own trajectory"
        )
    return poses, [f"truth: {path.name}, {frame_note}", f"{unknown} scans without truth"]


def in_laser_frame(poses: FloatArray, camera_from_laser: FloatArray) -> tuple[FloatArray, str]:
    """Transform poses of a planar motion to the laser's frame, x forward and z up.

    This project writes poses in a camera's frame, z forward and y down; most other programs write them with z
    up. The vertical axis is found as the one about which the body turns and along which it does not move.

    Args:
        poses: (N, 4, 4), in either frame.
        camera_from_laser: (4, 4), transform from the laser's frame to the camera's.

    Returns:
        Poses (N, 4, 4) of the laser, and a note that names the frame of the given poses.
    """
    own = np.linalg.inv(poses[0]) @ poses
    travelled = max(float(np.abs(own[:, :3, 3]).max()), 1e-9)
    z_up, y_down = (
        float(np.mean(1 - own[:, axis, axis])) + float(np.abs(own[:, axis, 3]).max()) / travelled
        for axis in (2, 1)
    )
    if z_up <= y_down:
        return poses, "in a frame with z up"
    return change_frame(poses, np.linalg.inv(camera_from_laser)), "in the camera's frame"


def _interpolate(poses: FloatArray, times: FloatArray, stamps: FloatArray) -> FloatArray:
    """Interpolate poses in time.

    Args:
        poses: (M, 4, 4).
        times: (M,) seconds of the poses, ascending.
        stamps: (N,) seconds.

    Returns:
        Poses (N, 4, 4) at the stamps; nan if a pose before or after is farther than ``FARTHEST_IN_TIME``.
    """
    planar = poses_to_planar(poses)
    after = np.clip(np.searchsorted(times, stamps), 0, len(times) - 1)
    before = np.where(np.abs(times[after] - stamps) < 1e-6, after, np.maximum(after - 1, 0))
    since, until = stamps - times[before], times[after] - stamps
    change = planar[after] - planar[before]
    change[:, 2] = wrap_angle(change[:, 2])  # the short way round
    part = np.clip(since / np.maximum(since + until, 1e-9), 0, 1)
    found = planar_to_poses(planar[before] + part[:, None] * change)
    inside = (since > -1e-6) & (until > -1e-6)
    found[~(inside & (np.maximum(since, until) <= FARTHEST_IN_TIME))] = np.nan
    return found
