"""How a driver goes along a route: the line of the wheels, the speed on it, and the sway of the car.

The constants and ranges here were learnt from the motion of KITTI's sequences 00 02 03 04 06 08 09, never
from 05, 07 or 10; ``python -m rcnn_odom.simulation.motion_table`` compares the two.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rcnn_odom.motion import FloatArray
from rcnn_odom.simulation.city import Plan, Roads, Route, Warp, random_route

Indices = npt.NDArray[np.int64]

FRAME_TIME = 0.1
"""Seconds from scan to scan."""

PATH_STEP = 0.25
LEAD_IN = 60.0
"""Metres of the driven line before the drive and after it, for the traffic ahead and behind."""

CLEARANCE = 2.75
"""Metres between the line planned round a corner and whatever may stand there; some go to straying."""

STEERING_LENGTH = 6.0
"""Metres over which the steering wheel is turned: the line is averaged over them twice."""

STRAYING_WAVES = (22.0, 80.0)
"""Metres after which a driver corrects the way in the lane."""

LEVER = (0.75, 1.0)
"""Metres of the laser ahead of the rear axle; with the slip of the tyres and the way driven while turning,
its step aside in turns comes to 0.78 to 0.95 metres a radian."""

SLIP = 0.008
"""Radians by which tyres slip outwards for every m/s^2 of lateral acceleration."""

MOUNTING = (-0.002, 0.005)
"""Radians by which a laser looks past the way that its car goes."""

ACCELERATION = (2.1, 3.1)
BRAKING = (2.7, 4.2)
"""m/s^2 that drivers are capable of, before `PEDAL_TIME` takes the edge off."""

EFFORT = (0.25, 1.0)
"""Share of it that a driver makes use of, changing along the way."""

EFFORT_WAVES = (60.0, 300.0)
SPEED_WAVES = (80.0, 500.0)
"""Metres over which effort and the speed in mind rise and fall."""

LATERAL_ACCELERATION = (2.6, 4.0)
"""m/s^2 that a driver bears in bends: the 99th percentile of each sequence with bends is 2.2 to 4.0."""

YAW_RATE = (0.5, 0.7)
"""Radians per second at most in a turn at a crossing."""

PEDAL_TIME = 1.6
"""Seconds over which the speed is averaged twice: no pedal is pressed at once."""

SPEED_VARIES = 0.15
"""Share by which the speed in mind rises and falls."""

TURN_SPEED = (1.0, 7.0)
"""Metres per second in the middle of a turn at a crossing, where its bend does not ask for less."""

GIVE_WAY_SPEED = (1.0, 7.0)
GIVE_WAY_BEFORE = 10.0
"""Metres before the middle of a crossing where a car that gives way is slowest."""

STOP = (2.5, 6.5)
"""Seconds of standing, of which braking and starting smoothly take some."""

CRAWL = 0.1
"""Metres per second at a stop line: a speed of 0 would never leave it."""

SWAY_HEIGHT = 1.2
"""Metres of the laser above the axis about which a car pitches and rolls: it moves with them."""

SWAY_FRAMES = 50
"""Frames after which a bump is forgotten."""

PITCH_OF_ACCELERATION = -0.0015
"""Radians of pitch (nose down) for every m/s^2 of speeding up."""

ROLL_OF_ACCELERATION = 0.0075
"""Radians of roll (left side up) for every m/s^2 to the left: a body leans outwards."""


@dataclass(frozen=True)
class Drive:
    """N frames of a drive.

    Attributes:
        planar: (N, 3) x and y in metres and heading in radians of the laser in the world.
        tilt: (N, 2) pitch (positive: nose down) and roll (positive: left side up) in radians of the car on
            its springs, relative to the road it stands on.
        path: (M, 2) metres, the line that the middle of the rear axle drives, points `PATH_STEP` apart; it
            begins before the drive and goes on after it.
        along: (N,) metres along the path.
    """

    planar: FloatArray
    tilt: FloatArray
    path: FloatArray
    along: FloatArray


@dataclass(frozen=True)
class _Sway:
    """Random tilt of one kind: noise of the road through a damped spring, and through slow leaning.

    Attributes:
        bounce_deg: standard deviation of the bounce on a usual road at 10 m/s.
        frequency: of the bounce in hertz.
        damping: of the bounce, as a share of the critical one.
        lean_deg: standard deviation of the slow part.
        lean_time: seconds after which it is forgotten.
    """

    bounce_deg: float
    frequency: float
    damping: float
    lean_deg: float
    lean_time: float


PITCH_SWAY = _Sway(bounce_deg=0.215, frequency=1.25, damping=0.25, lean_deg=0.7, lean_time=0.8)
ROLL_SWAY = _Sway(bounce_deg=0.175, frequency=1.0, damping=0.5, lean_deg=0.95, lean_time=0.8)
YAW_SWAY = _Sway(bounce_deg=0.0, frequency=1.0, damping=0.5, lean_deg=0.12, lean_time=1.0)


def random_drive(plan: Plan, warp: Warp, frames: int, rng: np.random.Generator) -> Drive:
    """Another drive for every draw from ``rng``; a longer one begins like a shorter one.

    Args:
        plan: the streets, whose kind says how they are driven.
        warp: from the plan to the world.
        frames: number of scans, `FRAME_TIME` apart.
        rng: where all choices come from.
    """
    route_rng, line_rng, speed_rng, body_rng = rng.spawn(4)
    roads = plan.roads
    fastest = roads.speed[1] * (1 + SPEED_VARIES)
    length = 2 * LEAD_IN + FRAME_TIME * (frames + 50) * fastest
    # More than asked for: rounding the corners and averaging shorten it.
    route = random_route(plan, 1.2 * length + 200, route_rng)
    path, crossings = _driven_line(route, warp, roads, line_rng)
    heading = _headings(path)
    # Two frames more at both ends, where differences of differences are one-sided.
    along = _travel(heading, crossings, route.turn, roads, frames + 4, speed_rng)
    planar, tilt = _laser(path, heading, along, roads, body_rng)
    path = path[: int((along[-1] + LEAD_IN) / PATH_STEP) + 1]
    return Drive(planar[2:-2], tilt[2:-2], path, along[2:-2])


def _laser(
    path: FloatArray, heading: FloatArray, along: FloatArray, roads: Roads, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """The laser's x, y and heading (N, 3), and pitch and roll (N, 2), on a car that is ``along`` a path."""
    lever, mounting = rng.uniform(*LEVER), rng.uniform(*MOUNTING)
    at = PATH_STEP * np.arange(len(path))
    axle = np.stack([np.interp(along, at, values) for values in path.T], axis=1)
    direction = np.interp(along, at, heading)
    speed = np.gradient(along, FRAME_TIME)
    aside = speed * np.gradient(direction, FRAME_TIME)
    pitch, roll, yaw = _sway(speed, aside, rng.uniform(*roads.roughness), rng).T
    faces = direction + SLIP * aside + yaw
    forward = np.stack([np.cos(faces), np.sin(faces)], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    laser = axle + (lever + SWAY_HEIGHT * pitch)[:, None] * forward - (SWAY_HEIGHT * roll)[:, None] * left
    planar = np.concatenate([laser, faces[:, None] - mounting], axis=1)
    return planar, np.stack([pitch, roll], axis=1)


# --- the line --------------------------------------------------------------------------------------


def _driven_line(
    route: Route, warp: Warp, roads: Roads, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """The route in the world: points (M, 2) every `PATH_STEP`, and the crossings (C,) in metres along it."""
    driven = _arc_length(route.points)
    fine = np.union1d(np.arange(0, driven[-1], 2 * PATH_STEP), driven[route.crossings])
    bent = warp(np.stack([np.interp(fine, driven, values) for values in route.points.T], axis=1))
    at = np.searchsorted(fine, driven[route.crossings])
    # Drawn before what depends on the number of crossings, so that a longer drive begins like a shorter one.
    straying, waves = rng.uniform(*roads.straying), _random_waves(STRAYING_WAVES, rng)
    rounded, at = _round_corners(bent, at, route, warp(route.inner), roads, rng)
    travelled = _arc_length(rounded)
    crossings = travelled[at]
    even = np.arange(0, travelled[-1], PATH_STEP)
    path = np.stack([np.interp(even, travelled, values) for values in rounded.T], axis=1)
    aside = straying * _meander(even, waves)
    tangent = np.gradient(path, PATH_STEP, axis=0)
    path += aside[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    window = round(STEERING_LENGTH / PATH_STEP)
    path = np.stack([_average_twice(values, window) for values in path.T], axis=1)
    # Averaging and straying have changed the distance between points.
    travelled = _arc_length(path)
    crossings = np.interp(crossings, even[window - 1 : 1 - window], travelled)
    even = np.arange(0, travelled[-1], PATH_STEP)
    return np.stack([np.interp(even, travelled, values) for values in path.T], axis=1), crossings


def _round_corners(
    line: FloatArray, at: Indices, route: Route, inner: FloatArray, roads: Roads, rng: np.random.Generator
) -> tuple[FloatArray, Indices]:
    """A line (M, 2) whose turns are curves, and where in it the crossings ``at`` (C,) are now."""
    travelled = _arc_length(line)
    gaps = np.diff(travelled[at], prepend=0.0, append=travelled[-1])
    pieces, new_at, first, count = [], [], 0, 0
    for number, index in enumerate(at):
        smallest, widest = roads.left_radius if route.turn[number] > 0 else roads.right_radius
        radius = smallest * (widest / smallest) ** rng.random()
        if route.turn[number] == 0:
            new_at.append(count + index - first)
            continue
        legs, curve = _turn(
            line, travelled, travelled[index], radius, inner[number], gaps[number : number + 2]
        )
        start, end = np.searchsorted(travelled, travelled[index] + np.array([-legs, legs]))
        pieces += [line[first:start], curve]
        new_at.append(count + start - first + len(curve) // 2)
        count += start - first + len(curve)
        first = end
    return np.concatenate([*pieces, line[first:]]), np.array(new_at)


def _turn(
    line: FloatArray,
    travelled: FloatArray,
    middle: float,
    radius: float,
    kerbs: FloatArray,
    gaps: FloatArray,
) -> tuple[float, FloatArray]:
    """How a turn at ``middle`` (metres along a line) is driven: as wide as wanted, or as there is room.

    It is a quadratic Bezier curve: its curvature rises and falls, as a driver turns the wheel.

    Args:
        line: (M, 2), with a sharp corner in the middle of the turn.
        travelled: (M,) metres along the line.
        middle: metres along the line.
        radius: metres, wanted at the tightest point.
        kerbs: (K, 2) points on the inner side that it keeps away from.
        gaps: (2,) metres to the crossings before and after.

    Returns:
        Metres before and after ``middle`` that the curve (P, 2) replaces, and the curve.
    """

    def points(at: FloatArray) -> FloatArray:
        return np.stack([np.interp(at, travelled, values) for values in line.T], axis=-1)

    widest = 0.45 * float(gaps.min())
    sides = points(middle + 6.0 * np.array([-1.0, 0.0, 1.0]))
    before, after = np.diff(sides, axis=0)
    half = abs(np.arctan2(before[0] * after[1] - before[1] * after[0], before @ after)) / 2
    wanted = min(radius * np.sin(half) / np.cos(half) ** 2, widest)
    legs = wanted * np.linspace(1, 0.1, 19)
    start, end = points(middle - legs), points(middle + legs)
    control = _meeting(start, start - points(middle - legs - 1), end, points(middle + legs + 1) - end)
    t = np.linspace(0, 1, 33)[:, None]
    curves = (1 - t) ** 2 * start[:, None] + 2 * t * (1 - t) * control[:, None] + t**2 * end[:, None]
    distance = np.hypot(*(curves[:, :, None] - kerbs).transpose(3, 0, 1, 2)).min(axis=(1, 2))
    fits = np.flatnonzero(distance > CLEARANCE)
    chosen = fits[0] if len(fits) else len(legs) - 1
    return float(legs[chosen]), curves[chosen]


def _meeting(start: FloatArray, before: FloatArray, end: FloatArray, after: FloatArray) -> FloatArray:
    """Where the tangents (P, 2) at both ends of curves meet, (P, 2)."""
    gap = end - start
    ahead = (gap[:, 0] * after[:, 1] - gap[:, 1] * after[:, 0]) / (
        before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    )
    return start + np.clip(ahead, 0, 2 * np.hypot(*gap.T))[:, None] * before


def _headings(path: FloatArray) -> FloatArray:
    """Unwrapped radians (M,) along a path (M, 2)."""
    return np.unwrap(np.arctan2(*np.gradient(path, axis=0).T[::-1]))


def _arc_length(points: FloatArray) -> FloatArray:
    """Metres from the first of points (N, 2) to each along them, (N,)."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def _average_twice(values: FloatArray, window: int) -> FloatArray:
    """Means over so many values, and again over the means; ``window - 1`` fewer at both ends."""
    box = np.ones(window) / window
    return np.convolve(values, np.convolve(box, box), mode="valid")


def _random_waves(lengths: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """Radians per metre and phases, (2, 3), of three waves that are so many metres long."""
    return np.stack([2 * np.pi / rng.uniform(*lengths, 3), rng.uniform(0, 2 * np.pi, 3)])


def _meander(along: FloatArray, waves: FloatArray) -> FloatArray:
    """A slow up and down between -1 and 1, (M,)."""
    mean: FloatArray = np.sin(along[:, None] * waves[0] + waves[1]).mean(axis=1)
    return mean


# --- the speed -------------------------------------------------------------------------------------


def _travel(
    heading: FloatArray,
    crossings: FloatArray,
    turn: Indices,
    roads: Roads,
    frames: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Metres along the path in every frame, (frames,).

    Args:
        heading: (M,) radians at every step of the path.
        crossings: (C,) metres along the path.
        turn: (C,) 0 where a crossing is passed straight on.
        roads: their kind.
        frames: how many.
        rng: of the driver.
    """
    along = PATH_STEP * np.arange(len(heading), dtype=np.float64)
    mood = 1 + SPEED_VARIES * _meander(along, _random_waves(SPEED_WAVES, rng))
    limit = np.minimum(_bend_limit(heading, rng), rng.uniform(*roads.speed) * mood)
    effort = np.mean(EFFORT) + np.ptp(EFFORT) / 2 * _meander(along, _random_waves(EFFORT_WAVES, rng))
    speeding_up, braking = rng.uniform(*ACCELERATION) * effort, rng.uniform(*BRAKING) * effort
    wait = _slow_at_crossings(limit, crossings, turn, roads, rng)
    speed = _fastest(limit, speeding_up, braking)
    step_time = 2 * PATH_STEP / (speed[1:] + speed[:-1])
    leave = wait + np.concatenate([[0.0], np.cumsum(step_time + wait[:-1])])
    arrive = leave - wait
    window = round(PEDAL_TIME / FRAME_TIME)
    start = np.interp(LEAD_IN, along, leave)
    time = start + FRAME_TIME * np.arange(frames + 2 * (window - 1))
    where = np.interp(time, np.stack([arrive, leave], axis=1).ravel(), along.repeat(2))
    return _average_twice(where, window)


def _bend_limit(heading: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Metres per second, (M,), that a driver likes in the bends of a path."""
    curvature = np.abs(np.gradient(heading, PATH_STEP)) + 1e-6
    lateral, yaw_rate = rng.uniform(*LATERAL_ACCELERATION), rng.uniform(*YAW_RATE)
    limit: FloatArray = np.minimum(np.sqrt(lateral / curvature), yaw_rate / curvature)
    return limit


def _slow_at_crossings(
    limit: FloatArray, crossings: FloatArray, turn: Indices, roads: Roads, rng: np.random.Generator
) -> FloatArray:
    """Lower the limit (M,) where one gives way; seconds of standing at every step, (M,)."""
    wait = np.zeros(len(limit))
    for at, straight, (yields, slowly, stops, duration) in zip(
        crossings, turn == 0, rng.random((len(crossings), 4)), strict=True
    ):
        middle, before = int(at / PATH_STEP), int((at - GIVE_WAY_BEFORE) / PATH_STEP)
        if before <= 0 or middle >= len(limit):
            continue
        if not straight:
            limit[middle] = min(limit[middle], TURN_SPEED[0] + slowly * np.ptp(TURN_SPEED))
        elif yields < roads.gives_way:
            limit[before] = min(limit[before], GIVE_WAY_SPEED[0] + slowly * np.ptp(GIVE_WAY_SPEED))
        if stops < roads.stops:
            limit[before] = CRAWL
            wait[before] = STOP[0] + duration * np.ptp(STOP)
    return wait


def _fastest(limit: FloatArray, speeding_up: FloatArray, braking: FloatArray) -> FloatArray:
    """The fastest speed (M,) below a limit with accelerations within two bounds, all (M,).

    In squared speed over the way an acceleration is a slope: the answer is the lower envelope.
    """
    rise, fall = 2 * PATH_STEP * np.cumsum(speeding_up), 2 * PATH_STEP * np.cumsum(braking)
    squared = np.minimum.accumulate(limit**2 - rise) + rise
    squared = np.minimum.accumulate((squared + fall)[::-1])[::-1] - fall
    return np.sqrt(np.maximum(squared, CRAWL**2))


# --- the sway --------------------------------------------------------------------------------------


def _sway(speed: FloatArray, aside: FloatArray, rough: float, rng: np.random.Generator) -> FloatArray:
    """Pitch, roll and yaw (N, 3) of the car on its springs and tyres, radians.

    Args:
        speed: (N,) metres per second.
        aside: (N,) m/s^2 to the left.
        rough: of the road.
        rng: of the road's bumps.
    """
    # A bump does nothing to a car that stands.
    bumps = np.sqrt(np.clip(speed, 0, None) / 10)
    bumps = np.concatenate([np.full(SWAY_FRAMES - 1, bumps[0]), bumps])
    noise = rough * bumps[:, None] * rng.standard_normal((len(bumps), 6))
    pitch = PITCH_OF_ACCELERATION * np.gradient(speed, FRAME_TIME) + _swing(PITCH_SWAY, noise[:, :2])
    roll = ROLL_OF_ACCELERATION * aside + _swing(ROLL_SWAY, noise[:, 2:4])
    return np.stack([pitch, roll, _swing(YAW_SWAY, noise[:, 4:])], axis=1)


def _swing(sway: _Sway, noise: FloatArray) -> FloatArray:
    """Radians (N,) after noise (N + SWAY_FRAMES - 1, 2) of the road went through bounce and lean."""
    time = FRAME_TIME * np.arange(SWAY_FRAMES)
    turned = 2 * np.pi * sway.frequency * time
    bounce = np.exp(-sway.damping * turned) * np.sin(turned)
    lean = time / sway.lean_time * np.exp(-time / sway.lean_time)
    total: FloatArray = sum(
        np.deg2rad(deviation_deg) * np.convolve(one, response / np.linalg.norm(response), mode="valid")
        for deviation_deg, response, one in (
            (sway.bounce_deg, bounce, noise[:, 0]),
            (sway.lean_deg, lean, noise[:, 1]),
        )
    )
    return total
