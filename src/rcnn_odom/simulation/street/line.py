"""The line that a car drives: the route bent with its streets, with round corners and some deviations."""

from functools import partial

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.street.city import Roads, Route, Warp
from rcnn_odom.simulation.street.polyline import arc_length, resample
from rcnn_odom.simulation.street.smooth import average_twice, meander, random_waves

Indices = npt.NDArray[np.int64]

PATH_STEP = 0.25
"""Metres between the points of the line."""
LEAD_IN = 60.0
"""Metres of the line before and after the drive, for the traffic behind and ahead."""

CLEARANCE = 2.75
"""Metres; least distance from the planned line of a turn to the inner kerb, including room for deviations."""

STEERING_LENGTH = 6.0
"""Metres of the window over which the line is averaged twice, because steering takes time."""

STRAYING_WAVES = (22.0, 80.0)
"""Metres, wavelengths of the deviations from the middle of the lane."""


def driven_line(
    route: Route, warp: Warp, roads: Roads, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Turn a route into the line that is driven in the world.

    Args:
        route: route through the plan.
        warp: deformation from the plan to the world.
        roads: kind of the roads.
        rng: source of all random choices.

    Returns:
        Points (M, 2) of the line in metres, `PATH_STEP` apart; and the crossings (C,) in metres along it.
    """
    driven = arc_length(route.points)
    fine = np.union1d(np.arange(0, driven[-1], 2 * PATH_STEP), driven[route.crossings])
    bent = warp(resample(route.points, driven, fine))
    at = np.searchsorted(fine, driven[route.crossings])
    # Drawn before the values for each crossing, so that a longer drive begins like a shorter one.
    straying, waves = rng.uniform(*roads.straying), random_waves(STRAYING_WAVES, rng)
    rounded, at = _round_corners(bent, at, route, warp(route.inner), roads, rng)
    travelled = arc_length(rounded)
    crossings = travelled[at]
    even = np.arange(0, travelled[-1], PATH_STEP)
    path = resample(rounded, travelled, even)
    aside = straying * meander(even, waves)
    tangent = np.gradient(path, PATH_STEP, axis=0)
    path += aside[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    window = round(STEERING_LENGTH / PATH_STEP)
    path = np.stack([average_twice(values, window) for values in path.T], axis=1)
    # Averaging and straying have changed the distance between points.
    travelled = arc_length(path)
    crossings = np.interp(crossings, even[window - 1 : 1 - window], travelled)
    even = np.arange(0, travelled[-1], PATH_STEP)
    return resample(path, travelled, even), crossings


def _round_corners(
    line: FloatArray, at: Indices, route: Route, inner: FloatArray, roads: Roads, rng: np.random.Generator
) -> tuple[FloatArray, Indices]:
    """Replace the sharp corners of a line by curves.

    Args:
        line: (L, 2) metres.
        at: (C,) indices of the crossings in the line.
        route: the route.
        inner: (C, K, 2) metres, points on the inner kerbs.
        roads: kind of the roads.
        rng: source of all random choices.

    Returns:
        The line (M, 2), and the new indices (C,) of the crossings.
    """
    travelled = arc_length(line)
    gaps = np.diff(travelled[at], prepend=0.0, append=travelled[-1])
    pieces, new_at, first, count = [], [], 0, 0
    for number, index in enumerate(at):
        smallest, widest = roads.left_radius if route.turn[number] > 0 else roads.right_radius
        radius = smallest * (widest / smallest) ** rng.random()
        if route.turn[number] == 0:
            new_at.append(count + index - first)
            continue
        legs, curve = _bend(
            line, travelled, travelled[index], radius, inner[number], gaps[number : number + 2]
        )
        start, end = np.searchsorted(travelled, travelled[index] + np.array([-legs, legs]))
        pieces += [line[first:start], curve]
        new_at.append(count + start - first + len(curve) // 2)
        count += start - first + len(curve)
        first = end
    return np.concatenate([*pieces, line[first:]]), np.array(new_at)


def _bend(
    line: FloatArray,
    travelled: FloatArray,
    middle: float,
    radius: float,
    kerbs: FloatArray,
    gaps: FloatArray,
) -> tuple[float, FloatArray]:
    """Plan the curve of a turn, with the wanted radius if there is room for it.

    It is a quadratic Bezier curve, whose curvature rises and falls like the steering angle of a driver.

    Args:
        line: (M, 2) metres, with a sharp corner in the middle of the turn.
        travelled: (M,) metres along the line.
        middle: metres along the line to the middle of the turn.
        radius: metres, wanted radius at the tightest point.
        kerbs: (K, 2) metres, points on the inner kerbs, from which the curve keeps `CLEARANCE`.
        gaps: (2,) metres to the crossings before and after.

    Returns:
        Metres before and after ``middle`` that the curve replaces, and the curve (P, 2).
    """
    points = partial(resample, line, travelled)
    widest = 0.45 * float(gaps.min())
    sides = points(middle + 6.0 * np.array([-1.0, 0.0, 1.0]))
    before, after = np.diff(sides, axis=0)
    half = abs(np.arctan2(before[0] * after[1] - before[1] * after[0], before @ after)) / 2
    wanted = min(radius * np.sin(half) / np.cos(half) ** 2, widest)
    legs = wanted * np.linspace(1, 0.1, 19)
    start, end = points(middle - legs), points(middle + legs)
    control = _cross_tangents(start, start - points(middle - legs - 1), end, points(middle + legs + 1) - end)
    t = np.linspace(0, 1, 33)[:, None]
    curves = (1 - t) ** 2 * start[:, None] + 2 * t * (1 - t) * control[:, None] + t**2 * end[:, None]
    distance = np.hypot(*(curves[:, :, None] - kerbs).transpose(3, 0, 1, 2)).min(axis=(1, 2))
    fits = np.flatnonzero(distance > CLEARANCE)
    chosen = fits[0] if len(fits) else len(legs) - 1
    return float(legs[chosen]), curves[chosen]


def _cross_tangents(start: FloatArray, before: FloatArray, end: FloatArray, after: FloatArray) -> FloatArray:
    """Points (P, 2) where the tangents at the ends of curves meet.

    Args:
        start, end: (P, 2) metres, ends of the curves.
        before, after: (P, 2) directions of the tangents there.
    """
    gap = end - start
    ahead = (gap[:, 0] * after[:, 1] - gap[:, 1] * after[:, 0]) / (
        before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    )
    return start + np.clip(ahead, 0, 2 * np.hypot(*gap.T))[:, None] * before


def headings(path: FloatArray) -> FloatArray:
    """Directions (M,) along a path (M, 2) in radians, not wrapped."""
    return np.unwrap(np.arctan2(*np.gradient(path, axis=0).T[::-1]))
