"""KITTI odometry: one ring of the Velodyne stands for the 2D laser (paper IV-A).

Layout: ``root/sequences/NAME/{velodyne/*.bin,calib.txt,times.txt}`` and ``root/poses/NAME.txt``.
"""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, change_frame
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.recordings.trajectory import is_rotation, numbers, read_kitti, read_lines

READER_VERSION = 2
"""Raised whenever the same files would give other scans."""

POINT_BYTES = 16
VELODYNE = (360.0, 0.18)
"""Degrees that a ring covers, and degrees between its beams."""
FARTHEST = np.float32(1e6)
"""Metres: what claims to be farther away is no return."""
SAMPLED_FRAMES = 20
RING_DROP = np.deg2rad(30.0)
"""The azimuth drops by more than this between rings; within one, close objects make it drop by up to 7."""

HALF_RING_SPACING = np.deg2rad(0.2)

LEVEL = np.deg2rad(0.15)
"""Elevation that the chosen ring is to be nearest to: a hair above horizontal. KITTI's two most level rings
lie at +0.06 to +0.25 and at -0.1 to -0.3 degrees, so that the one nearest to 0 would change between
sequences; the upper one is also the one that a pitching car turns into the road last."""

Points = npt.NDArray[np.float32]


def load(name: str, *, root: str | Path, ring: int | None = None) -> Recording:
    """One sequence of the KITTI odometry data.

    The truth is that of the laser: the poses on disk are the camera's and are moved with ``Tr``.
    The range of a return is the horizontal one, hypot(x, y): motion is estimated in the x-y plane, and
    so a wall keeps its depth whichever ring sees it. (The ring nearest to horizontal is within half a
    degree of it, where the slant range is the same to 4 parts in 100,000.)

    Args:
        name: folder under ``sequences``, for instance ``"05"``.
        root: folder that holds ``sequences`` and ``poses``.
        ring: which of the lasers, 0 the first in the file. None: the one whose median elevation is
            nearest to horizontal (see ``LEVEL``), one for the whole sequence.

    Raises:
        InputError: a file is missing, cut off or not as the format says.
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
    reader, chosen = _choose_ring(scans, stamps, ring)
    key = f"kitti {READER_VERSION} {reader.ring} {fingerprint_of_files}"
    return Recording(
        name=name,
        poses=change_frame(camera_poses, np.linalg.inv(camera_from_laser)),
        stamps=stamps,
        read_scan=reader,
        fingerprint=hashlib.sha256(key.encode()).hexdigest(),
        camera_from_laser=camera_from_laser,
        notes=(f"{len(scans)} scans", chosen),
    )


def recognises(path: Path) -> bool:
    """Whether it is the folder of a sequence."""
    return (path / "velodyne").is_dir()


def stream(path: Path, ring: int | None = None) -> ScanStream:
    """The scans of a sequence's folder, one after the other; its truth is not needed.

    Args:
        path: ``sequences/NAME``.
        ring: as for :func:`load`.

    Raises:
        InputError: a file is missing, cut off or not as the format says.
    """
    scans, _ = _list_scans(path / "velodyne")
    camera_from_laser = read_calibration(path / "calib.txt")
    stamps = _read_stamps(path / "times.txt")
    if len(stamps) != len(scans):
        raise InputError(
            f"{path}: {len(scans)} scans in velodyne/, but {len(stamps)} lines in times.txt; copy it again"
        )
    reader, chosen = _choose_ring(scans, stamps, ring)
    return ScanStream(
        name=path.resolve().name,
        scans=map(reader, range(len(scans))),
        total=len(scans),
        beams=VELODYNE,
        camera_from_laser=camera_from_laser,
        notes=(f"{len(scans)} scans", chosen),
    )


def _choose_ring(scans: list[Path], stamps: FloatArray, ring: int | None) -> tuple["RingReader", str]:
    """The reader of one ring for all scans, and words about it."""
    elevations = _ring_elevations(scans)
    if ring is None:
        ring = int(np.argmin(np.abs(elevations - LEVEL)))
    elif not 0 <= ring < len(elevations):
        raise InputError(
            f"data.ring must be 0 to {len(elevations) - 1}, not {ring} (of rcnn-odom run: --ring); left "
            "out, it is the most level one"
        )
    elevation = float(elevations[ring])
    chosen = f"ring {ring} of the Velodyne, median elevation {np.rad2deg(elevation):+.2f} degrees"
    return RingReader(tuple(map(str, scans)), ring, elevation, tuple(stamps.tolist())), chosen


@dataclass(kw_only=True)
class Options:
    """What ``conf/data/kitti.yaml`` sets beside what all recordings have."""

    ring: int | None = option(least=0, wanted="null or a whole number, not negative")


@dataclass(frozen=True)
class RingReader:
    """Frame index -> the returns of one ring, their ranges horizontal.

    A frame in which an earlier ring was split or lost has its rings elsewhere in the file: where the
    ring's elevation (radians) is far from the sequence's, the neighbour that has it is taken.
    """

    paths: tuple[str, ...]
    ring: int
    elevation: float
    stamps: tuple[float, ...]

    def __call__(self, frame: int) -> Scan:
        """Reads one frame.

        Raises:
            InputError: the frame cannot be read or has no such ring.
        """
        path = self.paths[frame]
        points = _read_points(path)
        starts = ring_starts(points)
        if self.ring >= len(starts):
            raise InputError(
                f"{path}: frame {frame} has {len(starts)} rings, so no ring {self.ring} (they count "
                "from 0); choose a smaller data.ring, or download the file again"
            )
        return Scan.from_points(self._find_ring(_split_rings(points, starts)), self.stamps[frame])

    def _find_ring(self, rings: list[Points]) -> Points:
        def distance(ring: Points) -> float:
            return abs(_median_elevation(ring) - self.elevation)

        if distance(rings[self.ring]) < HALF_RING_SPACING:
            return rings[self.ring]
        return min(rings[max(self.ring - 1, 0) : self.ring + 2], key=distance)


def ring_starts(points: Points) -> npt.NDArray[np.int64]:
    """Where every ring begins in points (P, 3 or more) that come laser by laser.

    Within a ring the azimuth in [0, 2 pi) grows; a ring begins where it drops. Noise that carries points
    back and forth over azimuth 0 does not begin another: each step back over it undoes a step forward.
    The angle itself is computed at the few candidate steps alone, since it is the costly part.

    Returns:
        (R,) indices, the first 0.
    """
    x, y = np.ascontiguousarray(points[:, :2].T)
    right = y < 0
    cross = x[:-1] * y[1:] - y[:-1] * x[1:]
    dot = x[:-1] * x[1:] + y[:-1] * y[1:]
    # A drop either passes between the left and the right half plane or is a clockwise turn.
    candidates = np.flatnonzero((right[:-1] != right[1:]) | (cross < -np.tan(RING_DROP) * dot))
    step = _azimuth(x, y, candidates + 1) - _azimuth(x, y, candidates)
    change = (step < -RING_DROP).astype(np.int64) - (step > 2 * np.pi - RING_DROP)
    # A frame may begin with a few points just short of azimuth 0: they belong to the first ring.
    short_of_zero = len(x) > 0 and _azimuth(x, y, np.array([0]))[0] > 2 * np.pi - RING_DROP
    level = np.cumsum(change) - int(short_of_zero)
    highest_before = np.maximum.accumulate(np.concatenate([[0], level]))[:-1]
    return np.concatenate([[0], candidates[level > highest_before] + 1])


def read_calibration(path: str | Path) -> FloatArray:
    """``Tr`` of a ``calib.txt``: laser to camera, (4, 4).

    Raises:
        InputError: there is no such file, no ``Tr:`` line in it, or not 12 numbers on the line.
    """
    for number, line in enumerate(read_lines(path, "give the odometry data's own"), start=1):
        if line.startswith("Tr:"):
            tr = np.eye(4)
            words = line[3:].split()
            tr[:3] = np.reshape(numbers(f"{path}:{number}", words, 12, "Tr has 12 finite numbers"), (3, 4))
            if not is_rotation(tr[:3, :3]):
                raise InputError(f"{path}:{number}: Tr holds no rotation; restore the original file")
            return tr
    raise InputError(f"{path}: no line starts with 'Tr:' (laser to camera); use the odometry data's own")


def _azimuth(x: Points, y: Points, at: npt.NDArray[np.int64]) -> FloatArray:
    return np.arctan2(y[at], x[at], dtype=np.float64) % (2 * np.pi)


def _split_rings(points: Points, starts: npt.NDArray[np.int64]) -> list[Points]:
    """The points (P, 3) of every ring."""
    ends = [*starts[1:], len(points)]
    return [points[start:end, :3] for start, end in zip(starts, ends, strict=True)]


def _ring_elevations(scans: list[Path]) -> FloatArray:
    """Median elevation in radians of every ring over sampled frames."""
    frames = np.unique(np.linspace(0, len(scans) - 1, SAMPLED_FRAMES).round().astype(int))
    elevations = []
    for frame in frames:
        points = _read_points(scans[frame])
        rings = _split_rings(points, ring_starts(points))
        elevations.append([_median_elevation(ring) for ring in rings])
    usual = int(np.median([len(of_frame) for of_frame in elevations]))
    # In single frames a neighbour can be nearer to horizontal: the median over frames settles on one.
    return np.nanmedian([of_frame[:usual] for of_frame in elevations if len(of_frame) >= usual], axis=0)


def _median_elevation(points: Points) -> float:
    if len(points) == 0:  # a frame without any return
        return float("nan")
    x, y, z = points.T
    return float(np.median(np.arctan2(z, np.hypot(x, y))))


def _read_points(path: str | Path) -> Points:
    try:
        values = np.fromfile(path, dtype="<f4")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); download it again") from error
    if len(values) == 0 or len(values) % 4:
        raise InputError(f"{path}: changed while it was in use, now cut off; download it again")
    points = values.reshape(-1, 4)
    if values.max() < FARTHEST and values.min() > -FARTHEST:
        return points  # the usual file, seen in a tenth of the time
    # A point that is not finite is how some drivers write a missing return.
    return points[(np.abs(points[:, :3]) < FARTHEST).all(1)]


def _list_scans(folder: Path) -> tuple[list[Path], str]:
    """Paths in the order of frames, all sizes checked, and a key that changes with any of the files."""
    found: dict[int, os.DirEntry[str]] = {}
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        stem, suffix = os.path.splitext(entry.name)
        if suffix != ".bin":
            continue
        if not stem.isdecimal() or int(stem) in found:
            raise InputError(f"{entry.path}: scans must be numbered, 000000.bin and up, once each; rename it")
        size = entry.stat().st_size
        if size == 0 or size % POINT_BYTES:
            raise InputError(
                f"{entry.path}: {size} bytes are no whole number of {POINT_BYTES}-byte points, so the file "
                "is empty or cut off; download it again"
            )
        found[int(stem)] = entry
    if not found:
        raise InputError(f"{folder}: no .bin file in it; unpack the odometry data set's velodyne data there")
    missing = next((frame for frame in range(len(found)) if frame not in found), None)
    if missing is not None:
        raise InputError(f"{folder}: frame {missing} is missing ({missing:06d}.bin); copy the folder again")
    entries = [found[frame] for frame in range(len(found))]
    key = "\n".join(f"{e.name} {e.stat().st_size} {e.stat().st_mtime_ns}" for e in entries)
    return [Path(entry.path) for entry in entries], key


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
    return np.ravel([numbers(f"{path}:{number}", line.split(), 1, wanted) for number, line in lines])
