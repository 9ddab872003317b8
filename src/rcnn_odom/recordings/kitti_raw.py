"""Reads drives of the KITTI raw data; the truth comes from the GPS/IMU.

Layout: ``DATE/DRIVE/{velodyne_points/{data/*.bin,timestamps.txt},oxts/data/*.txt}`` and, in ``DATE`` or
``DRIVE``, ``calib_velo_to_cam.txt``, ``calib_cam_to_cam.txt`` and ``calib_imu_to_velo.txt``.
"""

import hashlib
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.recordings.trajectory import is_rotation, parse_numbers, read_lines
from rcnn_odom.recordings.velodyne_files import (
    LONGEST_TURN,
    SHORTEST_TURN,
    TURN,
    VELODYNE,
    Scans,
    choose_beam,
    file_key,
    list_numbered,
)

READER_VERSION = 2
"""Increase it when the same files would give other scans."""

VELODYNE_FOLDER = "velodyne_points"
EARTH_RADIUS = 6378137.0
"""Metres, as in the raw data's development kit."""
SAME_MOMENT = 0.1
"""Seconds; largest time between a scan and its pose."""
FASTEST = 100.0
"""Metres per second; if the poses are faster, the GPS/IMU was wrong."""
LEAST_STEP, FEWEST_STEPS = 0.2, 5
"""The car's direction is checked if at least ``FEWEST_STEPS`` steps are longer than ``LEAST_STEP`` metres."""
MOST_SIDEWAYS = np.deg2rad(45.0)
"""Largest median angle between a car's heading and the direction in which it moves."""
LISTED_DRIVES = 10
"""Number of drives that a message lists."""
STAMP = re.compile(r"(\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d)(?:\.(\d{1,9})\d*)?")

T = TypeVar("T")


@dataclass(kw_only=True)
class Options:
    """Options of ``conf/data/kitti_raw.yaml`` that are not common to all recordings."""

    ring: int | None = option(least=0, wanted="null or a whole number, not negative")


def load(name: str, *, root: str | Path, ring: int | None = None) -> Recording:
    """Load a drive of the KITTI raw data.

    The poses of the GPS/IMU are projected to a plane by the Mercator projection of the development kit, and
    transformed to the laser with ``calib_imu_to_velo.txt``. Ranges are horizontal, as for the odometry data.

    Args:
        name: folder of the drive, for instance ``"2011_09_26_drive_0005_sync"``.
        root: folder that holds the drive, or the folders of the dates.
        ring: number of the laser in the files, counted from 0. None: the most level one.

    Raises:
        InputError: a file is missing, cut off or not in the expected format.
    """
    drive = _find_drive(Path(root), name)
    scans, notes = _list_scans(drive)
    camera_from_laser, camera_notes = _read_camera(drive)
    frames = list(scans)
    stamps = _read_stamps(drive / VELODYNE_FOLDER / "timestamps.txt", frames)
    poses = _read_truth(drive, frames, stamps)
    turns = _read_turns(drive / VELODYNE_FOLDER, frames)
    reader, chosen = choose_beam([entry.path for entry in scans.values()], stamps, ring, turns)
    key = f"kitti_raw {READER_VERSION} {reader.ring} {file_key(scans)}"
    return Recording(
        name=name,
        poses=poses,
        stamps=stamps,
        read_scan=reader,
        fingerprint=hashlib.sha256(key.encode()).hexdigest(),
        camera_from_laser=camera_from_laser,
        notes=(*notes, *camera_notes, *chosen),
    )


def recognises(path: Path) -> bool:
    """Whether the path is a drive's folder, its ``velodyne_points`` or their ``data``, or holds drives."""
    return _drive_of(path) is not None or bool(_drives_in(path))


def stream(path: Path, ring: int | None = None) -> ScanStream:
    """Stream the scans of a drive; no ground truth is needed.

    Args:
        path: folder of the drive, or its ``velodyne_points``, or their ``data``.
        ring: as for :func:`load`.

    Raises:
        InputError: a file is missing, cut off or not in the expected format; or the folder only holds drives.
    """
    drive = _drive_of(path)
    if drive is None:
        drives = _list_drives(path)
        raise InputError(f"{path}: holds KITTI raw drives but is not one itself; give one of {drives}")
    scans, notes = _list_scans(drive)
    if _find_calibration(drive, "calib_velo_to_cam.txt"):
        camera_from_laser, camera_notes = _read_camera(drive)
    else:
        camera_from_laser = FORWARD_CAMERA.copy()
        camera_notes = ("no calib_velo_to_cam.txt: trajectories are those of a camera in the laser's place",)
    stamps = _read_stamps(drive / VELODYNE_FOLDER / "timestamps.txt", list(scans))
    turns = _read_turns(drive / VELODYNE_FOLDER, list(scans))
    reader, chosen = choose_beam([entry.path for entry in scans.values()], stamps, ring, turns)
    return ScanStream(
        name=drive.resolve().name,
        scans=map(reader, range(len(scans))),
        total=len(scans),
        beams=VELODYNE,
        camera_from_laser=camera_from_laser,
        notes=(*notes, *camera_notes, *chosen),
    )


def _drive_of(path: Path) -> Path | None:
    """The folder of the drive to which a path belongs; None if it belongs to none."""
    if (path / VELODYNE_FOLDER).is_dir():
        return path
    whole = Path(os.path.abspath(path))
    if whole.name == "data":
        whole = whole.parent
    return whole.parent if whole.name == VELODYNE_FOLDER and whole.is_dir() else None


def _drives_in(folder: Path) -> list[str]:
    """The drives in the folder of a date, or in the folder that holds the dates, as relative paths."""
    found = [*folder.glob(f"*/{VELODYNE_FOLDER}"), *folder.glob(f"*_*_*/*/{VELODYNE_FOLDER}")]
    return sorted(str(path.parent.relative_to(folder)) for path in found if path.is_dir())


def _list_drives(folder: Path) -> str:
    """The first drives in a folder, for a message."""
    drives = _drives_in(folder)
    more = f" and {len(drives) - LISTED_DRIVES} more" if len(drives) > LISTED_DRIVES else ""
    return ", ".join(drives[:LISTED_DRIVES]) + more


def _find_drive(root: Path, name: str) -> Path:
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; set data.root to the folder that holds the drives")
    places = [root / name, *(date / name for date in sorted(root.iterdir()))]
    found = [place for place in places if place.is_dir()]
    if not found or _drives_in(found[0]):
        if (root / VELODYNE_FOLDER).is_dir():
            advice = "it is a drive itself: set data.root to the folder above"
        elif drives := _list_drives(root):
            advice = f"set data.train, data.val and data.test to some of {drives}"
        else:
            advice = "set data.root to the folder of dates or drives"
        raise InputError(f"{root}: no drive {name} in it or in a date's folder; {advice}")
    if len(found) > 1 and found[0] != places[0]:
        raise InputError(f"{root}: {found[0]} and {found[1]} are both {name}; name the date's folder too")
    return found[0]


def _list_scans(drive: Path) -> tuple[Scans, tuple[str, ...]]:
    """The files of a drive's scans by frame number, at least one, and notes about them."""
    folder = drive / VELODYNE_FOLDER / "data"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; unpack the drive's Velodyne data, of its _sync archive")
    scans = list_numbered(folder, ".bin")
    texts = {} if scans else list_numbered(folder, ".txt")
    if not scans and not texts:
        raise InputError(f"{folder}: no .bin and no .txt file in it; unpack the drive's Velodyne data again")
    notes = [f"{len(scans or texts)} scans"]
    unread = [path for path in folder.glob("*.txt") if path.stem.isdecimal()] if scans else []
    if unread:
        notes.append(f"{len(unread)} .txt files beside the .bin files are not read")
    frames = list(scans or texts)
    if lost := frames[-1] - frames[0] + 1 - len(frames):
        notes.append(f"{lost} frame numbers between the first and the last have no scan")
    return scans or texts, tuple(notes)


def _match_frames(path: Path, frames: list[int], found: Mapping[int, T], what: str) -> list[T]:
    """Find what belongs to each frame: by number, or by order if all numbers differ by the same amount.

    Args:
        path: file or folder of the items, for the error.
        frames: numbers of the frames.
        found: items by their numbers.
        what: name of the items, for the error.

    Raises:
        InputError: neither way gives one item for each frame.
    """
    if all(frame in found for frame in frames):
        return [found[frame] for frame in frames]
    numbers_found = sorted(found)
    if len(found) == len(frames):
        if len({number - frame for number, frame in zip(numbers_found, frames, strict=True)}) == 1:
            return [found[number] for number in numbers_found]
        lost = next(frame for frame in frames if frame not in found)
        raise InputError(
            f"{path}: as many {what} as scans, but their numbers differ: there is none for scan {lost}; copy "
            "the drive again, all of it"
        )
    raise InputError(
        f"{path}: {len(found)} {what} for {len(frames)} scans numbered {frames[0]} to {frames[-1]}; copy the "
        "drive again, all of it"
    )


def _read_stamps(path: Path, frames: list[int]) -> FloatArray:
    """Stamps of the frames (N,): seconds since 1970, as if the clock showed UTC."""
    lines = read_lines(path, "unpack the drive again")
    given = {number: line.strip() for number, line in enumerate(lines) if line.strip()}
    places = _match_frames(path, frames, {number: number for number in given}, "time stamps")
    stamps = np.array([_parse_stamp(f"{path}:{number + 1}", given[number]) for number in places])
    same = np.flatnonzero(np.diff(stamps) == 0)
    if len(same) and (stamps % 1 == 0).all():
        where = places[int(same[0]) + 1] + 1
        raise InputError(
            f"{path}:{where}: the stamps are whole seconds, several frames in one; take the drive's own "
            "file, which has their fractions"
        )
    return stamps


def _read_turns(folder: Path, frames: list[int]) -> FloatArray | None:
    """Seconds (N,) that each turn of the laser took; None if the files of their start and end are missing.

    A turn begins and ends behind the car. ``timestamps.txt`` holds the time in between at which the laser
    pointed ahead and triggered the cameras.
    """
    first, last = (folder / f"timestamps_{end}.txt" for end in ("start", "end"))
    if not first.is_file() or not last.is_file():
        return None
    turns = _read_stamps(last, frames) - _read_stamps(first, frames)
    return np.where((turns >= SHORTEST_TURN) & (turns <= LONGEST_TURN), turns, TURN)


def _parse_stamp(where: str, text: str) -> float:
    wanted = "a time stamp is like 2011-09-26 13:02:25.951199337; correct the line"
    match = STAMP.fullmatch(text)
    if match is None:
        raise InputError(f"{where}: found '{text[:40]}', but {wanted}")
    try:
        whole = datetime.fromisoformat(match[1]).replace(tzinfo=UTC).timestamp()
    except ValueError as error:
        raise InputError(f"{where}: {error}, but {wanted}") from error
    return (int(whole) * 10**9 + int((match[2] or "0").ljust(9, "0"))) / 10**9


def _find_calibration(drive: Path, name: str) -> Path | None:
    """A calibration file, in the drive's folder or in the folder of the date; None if there is none."""
    places = (drive, Path(os.path.abspath(drive)).parent)
    return next((folder / name for folder in places if (folder / name).is_file()), None)


def _need_calibration(drive: Path, name: str) -> Path:
    path = _find_calibration(drive, name)
    if path is None:
        raise InputError(
            f"{drive}: no {name} in it or in the folder above; unpack the date's calibration there, "
            "DATE_calib.zip"
        )
    return path


def _read_camera(drive: Path) -> tuple[FloatArray, tuple[str, ...]]:
    """Transform (4, 4) from the laser to the rectified camera, as ``Tr`` of the odometry data, and notes."""
    camera_from_laser = _read_transform(_need_calibration(drive, "calib_velo_to_cam.txt"))
    path = _find_calibration(drive, "calib_cam_to_cam.txt")
    if path is None:
        return camera_from_laser, ("no calib_cam_to_cam.txt: the camera's frame is not rectified",)
    rectified = np.eye(4)
    rectified[:3, :3] = _read_rotation(path, "R_rect_00")
    return rectified @ camera_from_laser, ()


def _read_transform(path: Path) -> FloatArray:
    transform = np.eye(4)
    transform[:3, :3] = _read_rotation(path, "R")
    transform[:3, 3] = _read_values(path, "T", 3)[1]
    return transform


def _read_rotation(path: Path, name: str) -> FloatArray:
    where, values = _read_values(path, name, 9)
    rotation = np.reshape(values, (3, 3))
    if not is_rotation(rotation):
        raise InputError(f"{where}: {name} holds no rotation; restore the original file")
    return rotation


def _read_values(path: Path, name: str, count: int) -> tuple[str, list[float]]:
    """File and line number of the line of this name, and the line's numbers."""
    for number, line in enumerate(read_lines(path, "unpack the date's calibration again"), start=1):
        if line.startswith(f"{name}:"):
            where = f"{path}:{number}"
            words = line[len(name) + 1 :].split()
            return where, parse_numbers(where, words, count, f"{name} has {count} finite numbers")
    raise InputError(f"{path}: no line starts with '{name}:'; unpack the date's calibration again")


def _read_truth(drive: Path, frames: list[int], stamps: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) of the laser; the origin is the position of the GPS/IMU at the first scan."""
    folder = drive / "oxts" / "data"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; the truth is needed, so unpack the drive's oxts data")
    laser_from_imu = _read_transform(_need_calibration(drive, "calib_imu_to_velo.txt"))
    files = {int(path.stem): path for path in folder.glob("*.txt") if path.stem.isdecimal()}
    chosen = _match_frames(folder, frames, files, "files")
    if (times := folder.parent / "timestamps.txt").is_file():
        taken = _read_stamps(times, [int(path.stem) for path in chosen])
        if (late := float(np.percentile(np.abs(taken - stamps), 95))) > SAME_MOMENT:
            raise InputError(
                f"{times}: the poses were measured up to {late:.1f} s from their scans; take the "
                "synchronised drive, _sync, where equal numbers belong together"
            )
    poses = _imu_poses(np.array([_read_oxts(path) for path in chosen]))
    _check_speed(poses[:, :3, 3], stamps, chosen)
    _check_direction(poses, folder)
    return poses @ np.linalg.inv(laser_from_imu)


def _check_speed(places: FloatArray, stamps: FloatArray, files: list[Path]) -> None:
    """Check that no position (N, 3) in metres is too far from the one before it.

    Raises:
        InputError: the speed between two positions is above ``FASTEST``.
    """
    distance, period = np.linalg.norm(np.diff(places, axis=0), axis=1), np.diff(stamps)
    # Stamps jitter, but the true time between two frames is never much shorter than the median.
    least = max(float(np.median(period)), 0.01) if len(period) else 0.0
    for step in np.flatnonzero(distance > FASTEST * np.maximum(period, least)):
        raise InputError(
            f"{files[step + 1]}:1: frame {int(files[step + 1].stem)} is {distance[step]:.0f} m from the one "
            f"before, {period[step]:.2f} s earlier; correct latitude, longitude and altitude"
        )


def _check_direction(poses: FloatArray, folder: Path) -> None:
    """Check that a car with these poses (N, 4, 4) does not move sideways.

    Raises:
        InputError: the median angle between heading and motion is above ``MOST_SIDEWAYS``.
    """
    steps = np.diff(poses[:, :2, 3], axis=0)
    length = np.hypot(*steps.T)
    moved = length > LEAST_STEP
    if np.count_nonzero(moved) < FEWEST_STEPS:
        return
    along = np.abs(np.sum(steps * poses[:-1, :2, 0], axis=1))[moved] / length[moved]
    aside = np.arccos(np.clip(np.median(along), 0.0, 1.0))
    if aside > MOST_SIDEWAYS:
        raise InputError(
            f"{folder}: the car moves {np.rad2deg(aside):.0f} degrees off its yaw angle, as if latitude and "
            "longitude were swapped, or yaw were in degrees; correct the files"
        )


def _read_oxts(path: Path) -> list[float]:
    """Latitude and longitude in degrees, altitude in metres; roll, pitch and yaw in radians."""
    wanted = "it begins with latitude, longitude, altitude, roll, pitch and yaw"
    values = parse_numbers(f"{path}:1", read_lines(path, "unpack the drive again")[0].split()[:6], 6, wanted)
    if not (abs(values[0]) < 90 and abs(values[1]) <= 360 and abs(values[2]) < 1e5):
        raise InputError(f"{path}:1: not a place on earth, but {wanted}; correct the line")
    if max(map(abs, values[3:])) > 2 * math.pi:
        raise InputError(f"{path}:1: an angle is above 2 pi, but {wanted} (radians); correct the line")
    return values


def _imu_poses(rows: FloatArray) -> FloatArray:
    """Poses (N, 4, 4), x east and y north, from rows (N, 6) as :func:`_read_oxts` returns them."""
    from scipy.spatial.transform import Rotation

    latitude, longitude = np.deg2rad(rows[:, :2].T)
    scale = EARTH_RADIUS * np.cos(latitude[0])
    north = np.log(np.tan(np.pi / 4 + latitude / 2))
    places = np.stack([scale * longitude, scale * north, rows[:, 2]], axis=1)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", rows[:, :2:-1]).as_matrix()
    poses[:, :3, 3] = places - places[0]
    return poses
