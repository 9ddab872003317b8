"""The truth of a recording that has none itself: a trajectory file beside it, matched by stamp."""

import re
from pathlib import Path

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, change_frame, planar_to_poses, poses_to_planar, wrap_angle
from rcnn_odom.recordings.trajectory import file_name, read_kitti, read_tum

MATCHER = "matcher"
"""``data.reference=matcher``: readers then give poses of nan, and training fills in those of the matcher."""
FARTHEST_IN_TIME = 0.5
"""Seconds: a pose that was measured further from its scan says nothing about it."""
ENDINGS = r"\.(gz|bz2|xz|zstd?|bag|active|mcap|db3|log|clf|jsonl?|txt)$"
"""What a trajectory leaves out of the name of its recording."""


def find_trajectory(reference: Path, name: str, has_clock: bool) -> Path:
    """The trajectory file of a recording.

    Args:
        reference: the file; or a folder with ``NAME.tum`` or ``NAME.txt``, or with the folder ``NAME`` that
            ``rcnn-odom run --out`` wrote. NAME is that of the recording, with or without its endings.
        name: of the recording.
        has_clock: its scans have stamps; otherwise the file with a line for each scan is looked for first.

    Raises:
        InputError: there is none.
    """
    if reference.is_file():
        return reference
    kinds = (".tum", ".txt") if has_clock else (".txt", ".tum")
    names = dict.fromkeys((file_name(name), Path(name).name, plain_name(name)))
    for each in names:
        for kind in kinds:
            for path in (reference / f"{each}{kind}", reference / each / f"trajectory{kind}"):
                if path.is_file():
                    return path
    wanted = plain_name(name)
    raise InputError(
        f"{reference}: no trajectory of {name} in it; put {wanted}.tum or {wanted}.txt there, or set "
        "data.reference=matcher"
    )


def plain_name(name: str) -> str:
    """A recording's name without folders and endings.

    >>> plain_name("logs/a.bag.gz")
    'a'
    """
    name = Path(name).name
    while (shorter := re.sub(ENDINGS, "", name)) not in (name, ""):
        name = shorter
    return name


def read_reference(
    path: Path, stamps: FloatArray, has_clock: bool, camera_from_laser: FloatArray
) -> tuple[FloatArray, list[str]]:
    """Laser poses (N, 4, 4) at the moments of scans, nan where the file has none near in time.

    Args:
        path: in TUM's format (``.tum``), found by stamp; or in KITTI's with a line for each scan.
        stamps: (N,) seconds, of the scans.
        has_clock: these are to be believed.
        camera_from_laser: (4, 4); the frame in which this project writes trajectories.

    Returns:
        The poses, and notes on them.

    Raises:
        InputError: the file cannot be read, or is not about these scans.
    """
    if path.suffix == ".tum":
        times, found = read_tum(path)
        times, first = np.unique(times, return_index=True)
        found, words = in_laser_frame(found[first], camera_from_laser)
        poses = _interpolate(found, times, stamps)
    else:
        found, words = in_laser_frame(read_kitti(path), camera_from_laser)
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
    return poses, [f"truth: {path.name}, {words}", f"{unknown} scans without truth"]


def in_laser_frame(poses: FloatArray, camera_from_laser: FloatArray) -> tuple[FloatArray, str]:
    """Poses (N, 4, 4) of a planar motion as those of the laser, x forward and z up, and words on their frame.

    This project writes them in a camera's frame, z forward and y down, most other programs with z up: the
    axis about which a body turns, and along which it does not move, tells which.
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
    """Poses (N, 4, 4) at ``stamps``, of those (M, 4, 4) at ascending ``times``; nan where none is near."""
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
