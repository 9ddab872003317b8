"""Reads KITTI odometry sequences: one ring of the Velodyne serves as the 2D laser (paper IV-A).

Layout: ``root/sequences/NAME/{velodyne/*.bin,calib.txt,times.txt}`` and ``root/poses/NAME.txt``.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, change_frame
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.recordings.trajectory import is_rotation, parse_numbers, read_kitti, read_lines
from rcnn_odom.recordings.velodyne_files import VELODYNE, choose_beam, file_key, list_numbered

READER_VERSION = 4
"""Increase it when the same files would give other scans. 4: points at the origin are not returns."""


def load(name: str, *, root: str | Path, ring: int | None = None) -> Recording:
    """Load a sequence of the KITTI odometry data.

    The poses on disk are those of the camera; they are transformed to the laser with ``Tr``.
    The range of a return is the horizontal distance, hypot(x, y), because motion is estimated in the x-y
    plane: so a wall has the same range in each ring. (The ring nearest to horizontal is within half a degree
    of it, where the slant range differs by less than 4 parts in 100,000.)

    Args:
        name: folder under ``sequences``, for instance ``"05"``.
        root: folder that holds ``sequences`` and ``poses``.
        ring: number of the laser in the files, counted from 0. None: the one whose median elevation is
            nearest to horizontal (see ``velodyne.LEVEL``), the same for the whole sequence.

    Raises:
        InputError: a file is missing, cut off or not in the expected format.
    """
    root = Path(root)
    folder = root / "sequences" / name
    _need_folder(root, "set data.root to the folder that holds sequences/ and poses/")
    _need_folder(folder, "take a sequence that is there, or set data.root")
    _need_folder(folder / "velodyne", "unpack the odometry data set's velodyne laser data there")
    scans, fingerprint_of_files = _list_scans(folder / "velodyne")
    camera_from_laser = read_calibration(folder / "calib.txt")
    stamps = _read_stamps(folder / "times.txt")
    camera_poses = _read_poses(root / "poses" / f"{name}.txt")
    if not len(scans) == len(stamps) == len(camera_poses):
        raise InputError(
            f"{folder}: {len(scans)} scans in velodyne/, {len(stamps)} lines in times.txt and "
            f"{len(camera_poses)} in the poses file; all three must agree, so copy the incomplete one again"
        )
    reader, chosen = choose_beam(scans, stamps, ring)
    key = f"kitti {READER_VERSION} {reader.ring} {fingerprint_of_files}"
    return Recording(
        name=name,
        poses=change_frame(camera_poses, np.linalg.inv(camera_from_laser)),
        stamps=stamps,
        read_scan=reader,
        fingerprint=hashlib.sha256(key.encode()).hexdigest(),
        camera_from_laser=camera_from_laser,
        notes=(f"{len(scans)} scans", *chosen),
        is_compensated=True,
    )


def recognises(path: Path) -> bool:
    """Whether the path is the folder of a sequence."""
    return (path / "velodyne").is_dir()


def stream(path: Path, ring: int | None = None) -> ScanStream:
    """Stream the scans of a sequence; no ground truth is needed.

    Args:
        path: folder of the sequence, ``sequences/NAME``.
        ring: as for :func:`load`.

    Raises:
        InputError: a file is missing, cut off or not in the expected format.
    """
    scans, _ = _list_scans(path / "velodyne")
    camera_from_laser = read_calibration(path / "calib.txt")
    stamps = _read_stamps(path / "times.txt")
    if len(stamps) != len(scans):
        raise InputError(
            f"{path}: {len(scans)} scans in velodyne/, but {len(stamps)} lines in times.txt; copy it again"
        )
    reader, chosen = choose_beam(scans, stamps, ring)
    return ScanStream(
        name=path.resolve().name,
        scans=map(reader, range(len(scans))),
        total=len(scans),
        beams=VELODYNE,
        camera_from_laser=camera_from_laser,
        notes=(f"{len(scans)} scans", *chosen),
        is_compensated=True,
    )


@dataclass(kw_only=True)
class Options:
    """Options of ``conf/data/kitti.yaml`` that are not common to all recordings."""

    ring: int | None = option(least=0, wanted="null or a whole number, not negative")


def read_calibration(path: str | Path) -> FloatArray:
    """Read ``Tr`` of a ``calib.txt``: the transform (4, 4) from the laser's frame to the camera's.

    Raises:
        InputError: there is no such file, it has no ``Tr:`` line, or the line does not hold 12 numbers with a
            rotation among them.
    """
    for number, line in enumerate(read_lines(path, "give the odometry data's own"), start=1):
        if line.startswith("Tr:"):
            tr = np.eye(4)
            words = line[3:].split()
            tr[:3] = np.reshape(
                parse_numbers(f"{path}:{number}", words, 12, "Tr has 12 finite numbers"), (3, 4)
            )
            if not is_rotation(tr[:3, :3]):
                raise InputError(f"{path}:{number}: Tr holds no rotation; restore the original file")
            return tr
    raise InputError(f"{path}: no line starts with 'Tr:' (laser to camera); use the odometry data's own")


def _list_scans(folder: Path) -> tuple[list[Path], str]:
    """Paths in the order of frames, after a check of all sizes, and a key that changes with any file."""
    found = list_numbered(folder, ".bin")
    if not found:
        raise InputError(f"{folder}: no .bin file in it; unpack the odometry data set's velodyne data there")
    missing = next((frame for frame in range(len(found)) if frame not in found), None)
    if missing is not None:
        raise InputError(f"{folder}: frame {missing} is missing ({missing:06d}.bin); copy the folder again")
    return [Path(entry.path) for entry in found.values()], file_key(found)


def _need_folder(folder: Path, advice: str) -> None:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; {advice}")


def _read_poses(path: Path) -> FloatArray:
    if not path.is_file():
        raise InputError(f"{path}: no such file; the ground truth is needed (KITTI has none for 11 to 21)")
    return read_kitti(path)


def _read_stamps(path: Path) -> FloatArray:
    lines = enumerate(read_lines(path, "give the time stamps of all scans"), start=1)
    wanted = "a time stamp is 1 finite number"
    return np.ravel([parse_numbers(f"{path}:{number}", line.split(), 1, wanted) for number, line in lines])
