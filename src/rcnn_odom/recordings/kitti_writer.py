"""Writes a simulated sequence in KITTI's odometry layout, for `kitti.load` and other programs."""

import os
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, change_frame
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.trajectory import write_kitti
from rcnn_odom.recordings.workers import Workers, useful_workers

Points = npt.NDArray[np.float32]

NO_RETURN = np.array([[np.nan, np.nan, np.nan, 0.0]], dtype=np.float32)
"""Written for a frame without returns, because readers would take an empty file for one that was cut off.
Readers drop a point that is not finite: some drivers write missing returns in this way."""

FOCAL, CENTRE, SHIFTS = 700.0, (600.0, 180.0), (0.0, -350.0, 0.0, -350.0)
"""Focal length and image centre in pixels, and shifts in pixels times metres (the right cameras are half a
metre to the right): rounded values of KITTI's four cameras. Readers expect P0 to P3, although the sequence
has no images."""


@runtime_checkable
class PointReader(Protocol):
    """A ``read_scan`` that also gives the points from which it makes scans."""

    def points(self, frame: int) -> Points:
        """x, y, z in metres in the laser's frame and reflectance, (P, 4), sorted by azimuth in [0, 2 pi)."""


def need_free_name(root: Path, name: str) -> None:
    """Check that a sequence of this name can be added below ``root``.

    Raises:
        InputError: the name cannot be the name of a folder, or is taken.
    """
    if not name or name.startswith(".") or os.path.basename(name) != name:
        raise InputError(f"sequence '{name}': must be the name of a folder, without / or a leading dot")
    for path in (root / "sequences" / name, root / "poses" / f"{name}.txt"):
        if path.exists():
            raise InputError(f"{path}: is there already; remove it, or choose another --out or --sequence")


def export_kitti(sequence: Recording, root: Path) -> None:
    """Write a sequence below ``root`` in KITTI's layout.

    As in KITTI, the poses are in the camera's frame and begin with the identity. `kitti.load` reads back
    exactly the same scans. The files are written to a hidden folder, which is moved when it is complete.

    Args:
        sequence: recording whose ``read_scan`` is a `PointReader`.
        root: folder for ``sequences`` and ``poses``.

    Raises:
        InputError: the name is not allowed or taken, or the files cannot be written.
    """
    need_free_name(root, sequence.name)
    reader = sequence.read_scan
    assert isinstance(reader, PointReader)
    try:
        for place in ("sequences", "poses"):
            (root / place).mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=root, prefix=f".{sequence.name}.", suffix=".partial") as hidden:
            folder, poses = Path(hidden, sequence.name), Path(hidden, "poses.txt")
            (folder / "velodyne").mkdir(parents=True)
            _write_scans(reader, sequence.name, len(sequence), Path(hidden))
            _write_calibration(folder / "calib.txt", sequence.camera_from_laser)
            np.savetxt(folder / "times.txt", sequence.stamps, fmt="%e")
            from_first = np.linalg.inv(sequence.poses[0]) @ sequence.poses
            write_kitti(poses, change_frame(from_first, sequence.camera_from_laser))
            # The poses are moved last: a reader refuses a sequence without poses as incomplete.
            folder.rename(root / "sequences" / sequence.name)
            poses.rename(root / "poses" / f"{sequence.name}.txt")
    except OSError as error:
        raise InputError(
            f"{root}: sequence {sequence.name} cannot be written ({error.strerror or error}); "
            "make room, or choose another --out"
        ) from error


def _write_scans(reader: PointReader, name: str, frames: int, root: Path) -> None:
    count = useful_workers(os.cpu_count() or 1, frames)
    remedy = f"free some and write sequence {name} again"
    with (
        Workers(count, partial(_write_frames, reader, root), remedy=remedy) as workers,
        tqdm(total=frames, desc=f"simulating {name}", unit="scan", disable=None) as bar,
    ):
        for (_, start, stop), _ in workers.run([name], [frames]):
            bar.update(stop - start)


def _write_frames(reader: PointReader, root: Path, name: str, start: int, stop: int) -> None:
    for frame in range(start, stop):
        points = reader.points(frame)
        points = points if len(points) else NO_RETURN
        (root / name / "velodyne" / f"{frame:06d}.bin").write_bytes(points.astype("<f4").tobytes())


def _write_calibration(path: Path, camera_from_laser: FloatArray) -> None:
    """``P0`` to ``P3`` of the rectified cameras, and ``Tr`` from the laser to camera 0."""
    x, y = CENTRE
    rows = {
        f"P{camera}": [FOCAL, 0, x, shift, 0, FOCAL, y, 0, 0, 0, 1, 0] for camera, shift in enumerate(SHIFTS)
    }
    rows["Tr"] = camera_from_laser[:3].ravel().tolist()
    lines = [f"{key}: " + " ".join(f"{number:.12e}" for number in row) for key, row in rows.items()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
