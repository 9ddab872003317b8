"""Reads numbered files of a Velodyne's points, one file a frame, as scans of one beam (KITTI's layouts)."""

import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.beams import Beams
from rcnn_odom.recordings.laser_frame import cone_spread, describe_steepness, find_rise, lower_points
from rcnn_odom.recordings.packing import refuse_pointer
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.trajectory import read_lines
from rcnn_odom.recordings.velodyne import (
    FARTHEST,
    HALF_RING_SPACING,
    LEVEL,
    NEAR_LEVEL,
    Beam,
    Points,
    are_thinned,
    find_level_beam,
    fit_beam,
    median_elevation,
    points_at,
    split_rings,
)

POINT_BYTES = 16
LARGEST_POINTER = 1024
"""Largest size of a Git LFS pointer, in bytes."""
VELODYNE = Beams(first=-180.0, covered=360.0, spacing=0.18)
TURN_DIRECTION = -1
"""The laser turns clockwise as seen from above; the stamp of a frame is the time when it points ahead."""
TURN = 0.1
"""Seconds of a turn, if the files do not show it."""
SHORTEST_TURN, LONGEST_TURN = 0.02, 0.5
"""Seconds; other durations of a turn are taken to be wrong."""
SAMPLED_FRAMES = 20
"""Number of frames from which the ring or beam is chosen."""
FRAMES_OF_BEAM = 5
"""Number of frames from which the elevation of a beam is found, if points are in any order."""
FEWEST_POINTS = 30
"""A frame with fewer points is blank: it may lack the beam."""
MOST_SPREAD = np.deg2rad(0.5)
"""Largest spread of a ring about its cone; KITTI's rings near level have 0.02 degrees."""
MOST_REFLECTANCE = 2**16
MOST_ODD = 0.01
"""Largest part of the points with an impossible reflectance."""

Scans = dict[int, os.DirEntry[str]]
"""Files by their frame numbers."""


def list_numbered(folder: Path, suffix: str) -> Scans:
    """List the files of a folder whose names are a number and the suffix; hidden files are left out.

    Raises:
        InputError: the name of a file with the suffix is not a number, two files have the same number, or the
            size of a file shows that it is empty, cut off or has other points.
    """
    found: Scans = {}
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        stem, its_suffix = os.path.splitext(entry.name)
        if its_suffix != suffix or stem.startswith("."):
            continue
        if not stem.isdecimal() or int(stem) in found:
            raise InputError(
                f"{entry.path}: scans must be numbered, 000000{suffix} and up, once each; rename it"
            )
        size = entry.stat().st_size
        if size < LARGEST_POINTER:
            refuse_pointer(entry.path, Path(entry.path).read_bytes())
        if fault := _fault_of_size(size, suffix):
            raise InputError(f"{entry.path}: {fault}")
        found[int(stem)] = entry
    return dict(sorted(found.items()))


def _fault_of_size(size: int, suffix: str) -> str | None:
    if size == 0:
        return "0 bytes in it, so the file is empty; download it again"
    if suffix != ".bin" or size % POINT_BYTES == 0:
        return None
    fault = f"{size} bytes are no whole number of {POINT_BYTES}-byte points, so the file is cut off"
    others = [floats for floats in (3, 5) if size % (4 * floats) == 0]
    if others:
        fault += f", or has {' or '.join(map(str, others))} 32-bit floats a point, not x y z reflectance"
    return f"{fault}; download it again" + (" or convert it" if others else "")


def file_key(scans: Scans) -> str:
    """A key that changes with the name, size or time of any file."""
    return "\n".join(f"{e.name} {e.stat().st_size} {e.stat().st_mtime_ns}" for e in scans.values())


def read_points(path: str | Path) -> Points:
    """Read the returns of a frame: (P, 4) float32, or (P, 3 or more) from a text file; metres.

    Points that are not finite, extremely far or at the origin are left out: drivers write them for missing
    returns.

    Args:
        path: ``.bin`` with four 32-bit floats a point, or ``.txt`` with a line ``x y z reflectance`` a point.

    Raises:
        InputError: the file cannot be read, or a line (named in the message) is not a point.
    """
    if Path(path).suffix == ".txt":
        points = _read_text(path)
        return _without_origin(points[(np.abs(points[:, :3]) < FARTHEST).all(1)].astype(np.float32))
    try:
        values = np.fromfile(path, dtype="<f4")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); download it again") from error
    if len(values) == 0 or len(values) % 4:
        raise InputError(f"{path}: changed while it was in use, now cut off; download it again")
    points = values.reshape(-1, 4)
    if values.max() < FARTHEST and values.min() > -FARTHEST:
        return _without_origin(points)  # the usual file; this check takes a tenth of the time
    return _without_origin(points[(np.abs(points[:, :3]) < FARTHEST).all(1)])


def _without_origin(points: Points) -> Points:
    at_origin = points[:, 0] == 0
    if at_origin.any():
        at_origin &= (points[:, 1] == 0) & (points[:, 2] == 0)
    return points[~at_origin] if at_origin.any() else points


def _read_text(path: str | Path) -> FloatArray:
    lines = read_lines(path, "download it again")
    try:
        points: FloatArray = np.loadtxt(lines, ndmin=2, comments=None)
    except ValueError as error:
        for number, line in enumerate(lines, start=1):
            if line.strip() and not _is_point(line, len(lines[0].split())):
                raise InputError(f"{path}:{number}: {_describe_fault(line)}") from error
        raise InputError(f"{path}: its lines are not points ({error}); download it again") from error
    if points.shape[1] < 3:
        raise InputError(f"{path}:1: {_describe_fault(lines[0])}")
    return points


def _describe_fault(line: str) -> str:
    return f"'{line.strip()[:40]}' is not a point, x y z reflectance; correct the line"


def _is_point(line: str, columns: int) -> bool:
    try:
        return len([float(word) for word in line.split()]) == columns >= 3
    except ValueError:
        return False


def choose_beam(
    paths: Iterable[str | Path], stamps: FloatArray, ring: int | None, turns: FloatArray | None = None
) -> tuple["BeamReader", tuple[str, ...]]:
    """Choose a beam from a sample of the frames.

    Args:
        paths: files of the frames, at least one.
        stamps: (N,) seconds, when the laser pointed ahead.
        ring: number of the laser in the files, counted from 0. None: the most level one, see ``LEVEL``.
        turns: (N,) seconds that each turn took; None: ``TURN``.

    Returns:
        The reader of the beam for all frames, and notes about the beam.

    Raises:
        InputError: a file cannot be read, there is no such ring, or none near level; or the points are not
            x y z reflectance in the laser's frame.
    """
    files = tuple(map(str, paths))
    frames = np.unique(np.linspace(0, len(files) - 1, SAMPLED_FRAMES).round().astype(int))
    clouds = _without_blank([read_points(files[frame]) for frame in frames])
    if not clouds:
        raise InputError(f"{files[0]}: neither this nor the other frames have a point; download them again")
    if files[0].endswith(".bin"):
        _check_reflectance(clouds, files[0])
    if ring is None and (fault := describe_steepness(clouds)):
        raise InputError(f"{files[0]}: {fault}; give them in the laser's frame, x ahead and z up")
    split = [split_rings(cloud) for cloud in clouds]
    ringed = [rings for rings in split if rings is not None]
    if 2 * len(ringed) < len(clouds):
        disordered = [cloud for cloud, rings in zip(clouds, split, strict=True) if rings is None]
        reader, notes = _choose_by_elevation(files, stamps, ring, disordered)
    else:
        reader, notes = _choose_by_ring(files, stamps, ring, ringed, len(clouds))
    return reader if turns is None else replace(reader, turns=tuple(turns.tolist())), notes


def _choose_by_ring(
    files: tuple[str, ...], stamps: FloatArray, ring: int | None, ringed: list[list[Points]], sampled: int
) -> tuple["BeamReader", tuple[str, ...]]:
    rise = find_rise(points for rings in ringed for points in rings)
    ringed = [[lower_points(points, rise) for points in rings] for rings in ringed]
    elevations = _ring_elevations(ringed)
    chosen, elevation = _choose_ring(elevations, ring, files[0])
    usual = [rings[chosen] for rings in ringed if len(rings) == len(elevations) and len(rings[chosen])]
    beam = fit_beam(np.concatenate(usual)) if usual else Beam(elevation)
    # A laser with a single beam may be tilted: it has no other ring with which this one could be confused.
    if ring is None and len(elevations) > 1 and usual and (spread := cone_spread(usual)) > MOST_SPREAD:
        raise InputError(
            f"{files[0]}: the points of ring {chosen} lie {np.rad2deg(spread):.1f} degrees from their cone, "
            "so they are not in the laser's frame; give them in that frame, or, if the ring is right, set "
            f"data.ring={chosen} (with rcnn-odom run: --ring {chosen})"
        )
    notes = [f"ring {chosen} of the Velodyne, median elevation {np.rad2deg(elevation):+.2f} degrees"]
    if rise:
        notes.append(f"points were shifted along z: beams meet at {rise:+.2f} m; elevations are from there")
    if others := sampled - len(ringed):
        notes.append(
            f"points of {others} in {sampled} frames are not laser by laser; their ring is found by elevation"
        )
    return BeamReader(files, tuple(stamps.tolist()), beam, chosen, elevation, rise), tuple(notes)


def _without_blank(clouds: list[Points]) -> list[Points]:
    """The clouds with at least a point, and at least 1 % of the points of the largest cloud."""
    most = max(map(len, clouds))
    return [cloud for cloud in clouds if len(cloud) > 0 and 100 * len(cloud) >= most]


def _check_reflectance(clouds: list[Points], path: str) -> None:
    values = np.concatenate([cloud[:, 3] for cloud in clouds])
    odd = np.mean((values < 0) | (values > MOST_REFLECTANCE))
    if odd > MOST_ODD:
        raise InputError(
            f"{path}: not four 32-bit floats a point (x y z reflectance): the fourth cannot be a reflectance "
            f"in {100 * odd:.0f} % of them; convert the files"
        )


def _choose_by_elevation(
    files: tuple[str, ...], stamps: FloatArray, ring: int | None, clouds: list[Points]
) -> tuple["BeamReader", tuple[str, ...]]:
    if ring is not None:
        raise InputError(
            f"{files[0]}: its points do not come laser by laser, so there is no ring {ring}; leave out "
            "data.ring (with rcnn-odom run: --ring) for the most level beam"
        )
    clouds = clouds[:: -(-len(clouds) // FRAMES_OF_BEAM)]
    try:
        beam = find_level_beam(clouds)
    except ValueError as error:
        raise InputError(
            f"{files[0]}: its points do not come laser by laser, and {error}; give all points as the laser "
            "measured them, in its own frame"
        ) from error
    beams = [points_at(cloud, *beam) for cloud in clouds]
    elevation = np.rad2deg(median_elevation(np.concatenate(beams)))
    notes = [f"points are not laser by laser; the beam at {elevation:+.2f} degrees is found by elevation"]
    if are_thinned(beams):
        notes.append(
            "points are thinned to a grid: scan matching tolerates that, but networks that were trained on "
            "all points give paths that are 10 % or more too short"
        )
    return BeamReader(files, tuple(stamps.tolist()), beam), tuple(notes)


def _choose_ring(elevations: FloatArray, ring: int | None, path: str) -> tuple[int, float]:
    if ring is not None and not 0 <= ring < len(elevations):
        raise InputError(
            f"data.ring must be 0 to {len(elevations) - 1}, not {ring} (with rcnn-odom run: --ring); leave "
            "it out for the most level one"
        )
    chosen = int(np.argmin(np.abs(elevations - LEVEL))) if ring is None else ring
    elevation = float(elevations[chosen])
    if ring is None and abs(elevation - LEVEL) > NEAR_LEVEL:
        raise InputError(
            f"{path}: the most level of its {len(elevations)} rings lies at {np.rad2deg(elevation):+.1f} "
            f"degrees, too far from level to see walls all round; if it is right, set data.ring={chosen} "
            f"(with rcnn-odom run: --ring {chosen})"
        )
    return chosen, elevation


def _ring_elevations(clouds: list[list[Points]]) -> FloatArray:
    """Median elevation (R,) in radians of each ring over the frames; a frame is a list of its rings."""
    elevations = [[median_elevation(ring) for ring in rings] for rings in clouds]
    usual = int(np.median([len(frame) for frame in elevations]))
    # The median over frames, because in single frames a neighbouring ring can be nearer to horizontal.
    return np.nanmedian([frame[:usual] for frame in elevations if len(frame) >= usual], axis=0)


@dataclass(frozen=True)
class BeamReader:
    """Reads the returns of one beam, with horizontal ranges, by the index of a frame.

    If an earlier ring of a frame was split or lost, the ring has another number in it: then the elevation of
    the ring is far from the usual one, and a neighbouring ring with that elevation is taken. In a frame whose
    points are not laser by laser, the points at the elevation of the beam are taken.

    Attributes:
        paths: files of the frames.
        stamps: seconds of each frame.
        beam: elevation and height of the beam.
        ring: number of the laser in the file; None if the points of no frame are laser by laser.
        elevation: radians, usual elevation of the ring, seen from the origin of the lowered points.
        rise: metres by which the points are lowered before use, see ``laser_frame.find_rise``.
        turns: seconds that the turn of each frame took; None: ``TURN``.
    """

    paths: tuple[str, ...]
    stamps: tuple[float, ...]
    beam: Beam
    ring: int | None = None
    elevation: float = float("nan")
    rise: float = 0.0
    turns: tuple[float, ...] | None = None

    def __call__(self, frame: int) -> Scan:
        """Read one frame.

        Raises:
            InputError: the frame cannot be read or has no such ring. (A blank frame gives no returns.)
        """
        scan = Scan.from_points(self._read_points(frame), self.stamps[frame])
        assert scan.bearings is not None
        turn = TURN if self.turns is None else self.turns[frame]
        return replace(scan, times=TURN_DIRECTION * turn / (2 * np.pi) * scan.bearings)

    def _read_points(self, frame: int) -> Points:
        path = self.paths[frame]
        points = lower_points(read_points(path), self.rise)
        rings = None if self.ring is None else split_rings(points)
        if self.ring is None or rings is None:
            return self._find_points(points, path, "its points do not come laser by laser, and none")
        # In a nearly blank frame, most rings are missing, so the number of a ring has no meaning.
        if self.ring >= len(rings) or (self.ring and len(points) < FEWEST_POINTS):
            has = f"frame {frame} has {len(rings)} rings, so no ring {self.ring} (they count from 0)"
            return self._find_points(points, path, f"{has}, and no point")
        return self._find_ring(rings, self.ring)

    def _find_ring(self, rings: list[Points], number: int) -> Points:
        def distance(ring: Points) -> float:
            return abs(median_elevation(ring) - self.elevation)

        if distance(rings[number]) < HALF_RING_SPACING:
            return rings[number]
        return min(rings[max(number - 1, 0) : number + 2], key=distance)

    def _find_points(self, points: Points, path: str, fault: str) -> Points:
        found = points_at(points, *self.beam)
        if len(points) >= FEWEST_POINTS and not len(found):
            raise InputError(
                f"{path}: {fault} is at the {np.rad2deg(self.beam.elevation):+.2f} degrees of the other "
                "frames' beam; download it again"
            )
        return found
