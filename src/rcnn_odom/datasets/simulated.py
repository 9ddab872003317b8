"""Drives through generated cities, seen by a 2D laser like one ring of an HDL-64.

The motion resembles KITTI's (10 Hz, about a metre a frame, slow turns at crossings); nothing else in
the city moves. A name stands for a city and a drive of its own, so ``05`` is always the same drive,
but it has nothing in common with KITTI's 05 except the name.
"""

import hashlib
import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rcnn_odom.datasets.sequence import Sequence
from rcnn_odom.errors import InputError
from rcnn_odom.motion import FloatArray, planar_to_poses, wrap_angle
from rcnn_odom.street import City, build_city, random_route

VERSION = 2
"""Counts changes of the generator: part of every fingerprint."""

FRAME_TIME = 0.1
SENSOR_AHEAD_OF_AXLE = 0.8
PATH_STEP = 0.25
WANDER = 0.3
"""Metres by which the driver strays from the middle of the lane, at most."""
WANTED_SPEED = (9.0, 13.5)
MAX_ACCELERATION = 1.85
MAX_LATERAL_ACCELERATION = 2.2
CRAWL = 0.1
"""Metres per second at a stop line: a speed of 0 would never leave it."""

BEAMS = 2083
MAX_RANGE = 80.0
RANGE_NOISE = 0.02
MISSING = 0.03

_CITY, _ROUTE, _WANDER, _SPEED, _SCAN = range(5)


def load(name: str, *, seed: int = 0, frames: int = 600) -> Sequence:
    """A simulated drive: another city for every name and seed.

    Args:
        name: any name; the same name and seed always give the same drive.
        seed: chooses the set of cities, 0 or more.
        frames: scans in the drive, at 10 Hz.

    Returns:
        The drive. Its scans are computed when they are read.

    Raises:
        InputError: fewer than two frames, or a negative seed.
    """
    if frames < 2:
        raise InputError(
            f"simulated sequence {name}: a drive has at least 2 frames, not {frames}; change data.frames"
        )
    if seed < 0:
        raise InputError(
            f"simulated sequence {name}: a seed is 0 or more, not {seed}; change data.world_seed"
        )
    city = build_city(_generator(seed, name, _CITY))
    planar = _drive(city, frames, seed, name)
    return Sequence(
        name=name,
        poses=planar_to_poses(planar),
        stamps=FRAME_TIME * np.arange(frames, dtype=np.float64),
        read_scan=ScanReader(city.segments, city.returned, city.roughness, planar, seed, name),
        fingerprint=hashlib.sha256(f"simulated {VERSION} {seed} {frames} {name}".encode()).hexdigest()[:16],
    )


def _generator(seed: int, name: str, *part: int) -> np.random.Generator:
    """Independent random numbers for each part of a drive, the same in every process."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), *part])


# --- the drive -----------------------------------------------------------------------------------


def _drive(city: City, frames: int, seed: int, name: str) -> FloatArray:
    """x, y and heading of the laser in every frame, (N, 3)."""
    longest = frames * FRAME_TIME * WANTED_SPEED[1]
    route, stops = random_route(city.plan, longest, _generator(seed, name, _ROUTE))
    path, stop_lines = _smooth_path(city, route, stops, _generator(seed, name, _WANDER))
    heading = np.unwrap(np.arctan2(*np.gradient(path, axis=0).T[::-1]))
    travelled = _travel(heading, stop_lines, frames, _generator(seed, name, _SPEED))
    along = PATH_STEP * np.arange(len(path), dtype=np.float64)
    x, y, direction = (np.interp(travelled, along, values) for values in (*path.T, heading))
    x += SENSOR_AHEAD_OF_AXLE * np.cos(direction)
    y += SENSOR_AHEAD_OF_AXLE * np.sin(direction)
    return np.stack([x, y, direction], axis=1)


def _smooth_path(
    city: City, route: FloatArray, stop_lines: list[int], rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """The route in the bent city, as points (M, 2) every ``PATH_STEP`` metres, and stop lines in metres.

    The steering wheel needs time to turn: the path is averaged over six metres. No driver keeps
    exactly to the lane.
    """
    driven = _arc_length(route)
    fine = np.arange(0, driven[-1], PATH_STEP)
    bent = city.warp(np.stack([np.interp(fine, driven, values) for values in route.T], axis=1))
    bent_driven = _arc_length(bent)
    window = round(6 / PATH_STEP)
    even = np.arange(0, bent_driven[-1], PATH_STEP)
    box = np.ones(window) / window
    path = np.stack(
        [np.convolve(np.interp(even, bent_driven, values), box, mode="valid") for values in bent.T], axis=1
    )
    along = np.gradient(path, PATH_STEP, axis=0)
    aside = WANDER * _meander(PATH_STEP * np.arange(len(path), dtype=np.float64), (25, 80), rng)
    path += aside[:, None] * along @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    return path, np.interp(driven[stop_lines], fine, bent_driven) - window / 2 * PATH_STEP


def _arc_length(points: FloatArray) -> FloatArray:
    """Metres from the first of points (N, 2) to each along them, (N,)."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def _travel(heading: FloatArray, stop_lines: FloatArray, frames: int, rng: np.random.Generator) -> FloatArray:
    """Metres along the path in every frame, (frames,): slow in turns, waiting at some stop lines.

    Args:
        heading: (M,) radians at every step of the path.
        stop_lines: (K,) metres along the path.
    """
    along = PATH_STEP * np.arange(len(heading), dtype=np.float64)
    wanted = _wanted_speed(along, rng)
    wait = _waits(len(heading), stop_lines, rng)
    curvature = np.abs(np.gradient(heading, PATH_STEP))
    limit = np.minimum(wanted, np.sqrt(MAX_LATERAL_ACCELERATION / (curvature + 1e-6)))
    limit[wait > 0] = CRAWL
    # The fastest drive below the limit is its lower envelope of slopes 2a in squared speed.
    slope = 2 * MAX_ACCELERATION * along
    squared = np.minimum.accumulate(limit**2 - slope) + slope
    squared = np.minimum.accumulate((squared + slope)[::-1])[::-1] - slope
    speed = np.sqrt(squared)
    step_time = 2 * PATH_STEP / (speed[1:] + speed[:-1])
    leave = wait + np.concatenate([[0.0], np.cumsum(step_time + wait[:-1])])
    time = FRAME_TIME * np.arange(frames)
    step = np.searchsorted(leave - wait, time, side="right") - 1
    since = np.maximum(time - leave[step], 0)
    acceleration = np.diff(squared)[step] / (2 * PATH_STEP)
    return along[step] + speed[step] * since + acceleration * since**2 / 2


def _wanted_speed(along: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Metres per second, (M,), rising and falling over some hundred metres."""
    low, high = WANTED_SPEED
    return (low + high) / 2 + (high - low) / 2 * _meander(along, (200, 800), rng)


def _meander(along: FloatArray, lengths: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """A slow random up and down between -1 and 1, (M,), of waves that are so many metres long."""
    waves = 2 * np.pi / rng.uniform(*lengths, 3)
    return np.sin(along[:, None] * waves + rng.uniform(0, 2 * np.pi, 3)).mean(axis=1)


def _waits(steps: int, stop_lines: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Seconds of standing at every step of the path, (steps,): at most one stop in half a kilometre."""
    wait = np.zeros(steps)
    last = -rng.uniform(0, 500)
    for line in stop_lines[stop_lines < PATH_STEP * (steps - 1)]:
        stops, duration = rng.random() < 0.12, rng.uniform(1, 2.4)
        if stops and line > max(last + 500, 20):
            wait[int(line / PATH_STEP)] = duration
            last = line
    return wait


# --- the laser -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class ScanReader:
    """Looks at the city from the poses of a drive: the ``read_scan`` of a simulated sequence.

    Attributes:
        segments: (S, 4) metres.
        returned: (S,) chance that a beam on a segment comes back.
        roughness: (S,) metres, standard deviation of the depth of a segment.
        planar: (N, 3) x and y in metres and heading in radians of the laser.
        seed: of the drive.
        name: of the drive.
    """

    segments: FloatArray
    returned: FloatArray
    roughness: FloatArray
    planar: FloatArray
    seed: int
    name: str

    def __call__(self, index: int) -> tuple[FloatArray, FloatArray]:
        """Angles in radians and ranges in metres, both (P,), of the beams that came back."""
        index = range(len(self.planar))[index]
        rng = _generator(self.seed, self.name, _SCAN, index)
        angles = rng.uniform(-np.pi, np.pi) + np.linspace(0, 2 * np.pi, BEAMS, endpoint=False)
        depth, segment = cast_rays(self.segments, self.planar[index], angles)
        sigma = np.hypot(RANGE_NOISE, self.roughness[segment])
        ranges = depth + sigma * rng.standard_normal(BEAMS)
        chance = (1 - MISSING) * self.returned[segment]
        back = (rng.random(BEAMS) < chance) & (ranges > 0) & (ranges < MAX_RANGE)
        return wrap_angle(angles[back]), ranges[back]


def cast_rays(
    segments: FloatArray, pose: FloatArray, angles: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Depth of the nearest segment along every beam, by a depth buffer over the beams.

    Args:
        segments: (S, 4) metres, in the world.
        pose: (3,) x, y in metres and heading in radians of the laser in the world.
        angles: (B,) radians from straight ahead: a full circle of evenly spaced beams.

    Returns:
        Depth (B,) in metres, inf where nothing is within ``MAX_RANGE``, and the segment (B,) that
        was hit, meaningless where nothing was.
    """
    near = _near(segments, pose)
    start, end = _seen_from(segments[near].reshape(-1, 2, 2), pose)
    first, count = _beams_covered(start, end, angles)
    owner = np.repeat(np.arange(len(near)), count)
    position = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    beam = (first[owner] + position) % len(angles)
    along = end - start
    across = start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]
    slant = np.cos(angles)[beam] * along[owner, 1] - np.sin(angles)[beam] * along[owner, 0]
    # A beam along a segment meets it at no single point; its neighbours at the end do the hiding.
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = across[owner] / slant
    depth = np.where((depth > 0) & (depth < MAX_RANGE), depth, np.inf)
    nearest = np.full(len(angles), np.inf)
    np.minimum.at(nearest, beam, depth)
    hit = np.zeros(len(angles), dtype=np.int64)
    wins = depth == nearest[beam]
    hit[beam[wins]] = near[owner[wins]]
    return nearest, hit


def _near(segments: FloatArray, pose: FloatArray) -> npt.NDArray[np.int64]:
    """Indices of the segments of which any point can lie within range."""
    x, y = (segments[:, 0] + segments[:, 2]) / 2 - pose[0], (segments[:, 1] + segments[:, 3]) / 2 - pose[1]
    half = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]) / 2
    return np.flatnonzero(x * x + y * y < (MAX_RANGE + half) ** 2)


def _seen_from(points: FloatArray, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both ends (S, 2) of segments (S, 2, 2) in the frame of a laser at ``pose``."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    seen = (points - pose[:2]) @ np.array([[cos, -sin], [sin, cos]])
    return seen[:, 0], seen[:, 1]


def _beams_covered(
    start: FloatArray, end: FloatArray, angles: FloatArray
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """First beam and number of beams, (S,) each, within the angle that each segment covers."""
    spacing = 2 * np.pi / len(angles)
    azimuth = np.arctan2(start[:, 1], start[:, 0])
    turn = wrap_angle(np.arctan2(end[:, 1], end[:, 0]) - azimuth)
    begin = (azimuth + np.minimum(turn, 0) - angles[0]) / spacing
    first = np.ceil(begin).astype(np.int64)
    last = np.floor(begin + np.abs(turn) / spacing).astype(np.int64)
    return first, np.maximum(last - first + 1, 0)
