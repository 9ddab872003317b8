"""Checks that points are in the frame of their laser, where each ring lies on a cone about the z axis.

A cloud that was shifted along z, for instance to the ground or to a robot's base, can still be used, because
only the apex of the cones moves. In a tilted cloud, or in a camera's frame, the points of a ring lie on no
such cone.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.velodyne import HIGHEST, HIGHEST_RISE, Points, elevations_from, fit_beam

STEEP = np.deg2rad(45.0)
MOST_STEEP = 0.3
"""Largest part of the points that are steeper than ``STEEP``; in a camera's frame nearly half of them are."""
LEAST_NARROWING = 2.0
"""A rise must make the rings at least this many times narrower."""
ONE_SIGMA = 68.0
"""Per cent of a normal distribution within one standard deviation."""


def describe_steepness(clouds: Sequence[Points]) -> str:
    """Why clouds, each (P, 3 or more), are not in their laser's frame; empty if they can be."""
    points = np.concatenate(clouds)
    steep = float(np.mean(np.abs(elevations_from(points, 0.0)) > STEEP)) if len(points) else 0.0
    if steep <= MOST_STEEP:
        return ""
    return f"{100 * steep:.0f} % of the points are steeper than 45 degrees, as in a camera's frame"


def find_rise(rings: Iterable[Points]) -> float:
    """Find the height in metres by which points were shifted along z; 0 if no shift is evident.

    It is the height at which the beams meet, fitted to all rings, if this height makes the rings clearly
    narrower than a height within ``HIGHEST`` of the origin does.

    Args:
        rings: the points (P, 3 or more) of each laser.
    """
    centred = [_centre(ring) for ring in rings if len(ring)]
    if not centred:
        return 0.0
    closeness, slope = np.concatenate(centred, axis=1)
    square = float(closeness @ closeness)
    if square < 1e-9:
        return 0.0
    rise = float(np.clip(closeness @ slope / square, -HIGHEST_RISE, HIGHEST_RISE))
    usual = float(np.clip(rise, -HIGHEST, HIGHEST))
    width, width_without = (float(np.median(np.abs(slope - h * closeness))) for h in (rise, usual))
    return rise if LEAST_NARROWING * width < width_without else 0.0


def _centre(ring: Points) -> FloatArray:
    """1 / distance and z / distance (2, P) of a ring's points, minus their means."""
    x, y, z = ring[:, :3].astype(np.float64).T
    distance = np.maximum(np.hypot(x, y), 1.0)
    both = np.stack([1 / distance, z / distance])
    centred: FloatArray = both - both.mean(axis=1, keepdims=True)
    return centred


def lower_points(points: Points, rise: float) -> Points:
    """Shift points (P, 3 or more) down by ``rise`` metres, so that the beams meet at height 0."""
    if rise == 0.0:
        return points
    points = points.copy()
    points[:, 2] -= rise
    return points


def cone_spread(rings: Iterable[Points]) -> float:
    """Robust standard deviation in radians of one laser's points about their cone.

    Args:
        rings: the points (P, 3 or more) of the laser, one array for each frame.
    """
    points = np.concatenate([ring[:, :3] for ring in rings])
    if not len(points):
        return 0.0
    beam = fit_beam(points)
    return float(np.percentile(np.abs(elevations_from(points, beam.height) - beam.elevation), ONE_SIGMA))
