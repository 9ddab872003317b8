"""Writes a simulated sequence in KITTI's odometry layout, which `kitti.load` and other tools read."""

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
"""Stands for a frame in which no beam came back: a file of 0 bytes would pass for one cut off. Readers
drop a point that is not finite, which is how some drivers write a missing return."""

FOCAL, CENTRE, SHIFTS = 700.0, (600.0, 180.0), (0.0, -350.0, 0.0, -350.0)
"""Pixels, and pixels times metres (the right cameras are half a metre to the right): KITTI's four cameras in
round numbers. Nothing is rendered with them, but readers expect P0 to P3."""


@runtime_checkable
class PointReader(Protocol):
    """A ``read_scan`` that also gives the points it makes scans of."""

    def points(self, frame: int) -> Points:
        """x, y, z in metres in the laser's frame and reflectance, (P, 4), by azimuth in [0, 2 pi)."""


def need_free_name(root: Path, name: str) -> None:
    """Check that a sequence of this name can be added below ``root``.

    Raises:
        InputError: the name is no plain name of a folder, or is taken.
    """
    if not name or name.startswith(".") or os.path.basename(name) != name:
        raise InputError(f"sequence '{name}': must be the name of a folder, without / and no dot first")
    for path in (root / "sequences" / name, root / "poses" / f"{name}.txt"):
        if path.exists():
            raise InputError(f"{path}: is there already; remove it, or choose another --out or --sequence")


def export_kitti(sequence: Recording, root: Path) -> None:
    """Write a sequence, whose ``read_scan`` is a `PointReader`, below ``root`` in KITTI's layout.

    The poses are told in the camera's frame and begin with the identity, as KITTI's do; what `kitti.load`
    reads back has the same scans to the bit. All is made in a hidden folder and moved when complete.

    Raises:
        InputError: the name is taken or unfit, or the files cannot be written.
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
            # The poses come last: without them a reader takes the sequence for incomplete.
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
