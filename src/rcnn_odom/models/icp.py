"""Scan matching between consecutive scans: point-to-line ICP.

Censi, "An ICP variant using a point-to-line metric", ICRA 2008. As there, a point is drawn to a line and
not to a point of the other scan. Unlike there, lines are fitted to all neighbours at hand instead of two,
the closed form is one Gauss-Newton step, and outliers lose weight by their residual instead of being trimmed
at a quantile: a gate on the distance closes from step to step.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial import cKDTree

from rcnn_odom.geometry import FloatArray, Step, Steps, planar_to_poses, wrap_angle
from rcnn_odom.models.contract import Description, Model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Drive

LINE_REACH, LINE_GAP = 0.2, 0.2
"""Metres from a point to the neighbours that its line is fitted to, and between two of these: more is a jump
from one thing to another behind it."""
SPARSE_REACH, SPARSE_GAP = 4.0, 8.0
"""The same for far points, in distances between neighbours on a wall that is seen squarely; they add up."""
MOST_NEIGHBOURS = 50
"""On each side: on near walls there are more, and as many are smooth enough."""
STRAIGHT = 0.1
"""Spread across a line over the spread along it, as variances, above which neighbours are no line."""

CLOSEST_GATE, GATE_CLOSES = 0.25, 0.6
"""Metres where the gate stops, and by what it shrinks in each step: it is open for wrong guesses."""
SAME_WALL = np.cos(np.deg2rad(45.0))
"""Cosine between two normals, below which a pair shows two different walls."""
CALM = 0.04
"""Times the gate: residuals of this size keep their weight even where most are smaller. A centimetre at last;
while the gate is open the few walls across a street must pull as well as the many along it."""
SETTLED = np.array([1e-4, 1e-4, 1e-5])
"""Metres and radians: a change of the step below it is the last."""
DAMPING = 1e-4
"""Beside a mean square of 1: damping keeps unconstrained directions from diverging."""

FEWEST_PAIRS = 15
LEAST_SHARE, DOUBTFUL_SHARE = 0.4, 0.6
"""Part of the points that must find a partner; and below which other guesses are tried as well."""
LEAST_CONSTRAINT = 0.05
"""Root mean square of the residuals' change over metres in a direction or radians of a turn: below it speaks
only the noise of the fitted lines, as along a bare corridor."""
OTHER_TURNS = np.deg2rad([0.0, 20.0, -20.0, 40.0, -40.0])
"""Guesses at rest, tried when the last motion leads nowhere."""


@dataclass(frozen=True, eq=False)
class Outline:
    """The points of a scan that lie on lines.

    Attributes:
        points: (P, 2) metres, x forward, y left, in angular order.
        normals: (P, 2) of the lines through them, unit length, towards the laser.
        chosen: (K,) indices of at most ``beams`` points that are matched to another outline's lines.
        tree: finds the nearest of ``points``; None where there is none.
    """

    points: FloatArray
    normals: FloatArray
    chosen: npt.NDArray[np.int64]
    tree: cKDTree | None


@dataclass(frozen=True, eq=False)
class Match:
    """Where the later of two scans was taken.

    Attributes:
        step: (3,) x and y in metres and heading in radians in the frame of the earlier scan.
        failed: the scans do not overlap, and ``step`` is the guess; or they say nothing about a direction,
            and along it ``step`` is the guess.
        share: part of the later scan's chosen points that found a partner.
    """

    step: FloatArray
    failed: bool
    share: float


@dataclass(frozen=True)
class PointToLineICP:
    """Finds the step between two scans.

    Attributes:
        sensor: of the depth vectors.
        beams: at most so many points of the later scan are matched, every k-th return; lines are fitted to
            all returns of the earlier one.
        max_iterations: of one match.
        max_distance: metres between a point and its partner in the first step: how wrong a guess may be.
    """

    sensor: Sensor
    beams: int = 450
    max_iterations: int = 30
    max_distance: float = 5.0

    def outline(self, scan: npt.ArrayLike) -> Outline:
        """Points and lines of one depth vector (bins,) in metres."""
        sensor = self.sensor
        closed = sensor.field_of_view_deg == 360
        ranges = np.asarray(scan, dtype=np.float64)[: sensor.bins - closed]
        bins = np.flatnonzero((ranges > 0) & np.isfinite(ranges))
        ranges = ranges[bins]
        angles = np.deg2rad(bins * sensor.resolution_deg + sensor.first_bin_deg)
        points = np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=1)
        spacing = np.median(np.diff(angles)) * ranges if len(bins) > 1 else ranges
        normals = np.empty_like(points)
        _fit_lines(
            points, LINE_REACH + SPARSE_REACH * spacing, LINE_GAP + SPARSE_GAP * spacing, closed, normals
        )
        on_line = np.isfinite(normals[:, 0])
        points, normals = points[on_line], normals[on_line]
        chosen = np.linspace(0, len(points) - 1, min(self.beams, len(points))).round().astype(np.int64)
        # Built without balancing: looked up a few thousand times, it would not pay back.
        tree = cKDTree(points, balanced_tree=False, compact_nodes=False) if len(points) else None
        return Outline(points, normals, chosen, tree)

    def match(self, earlier: Outline, later: Outline, guess: FloatArray) -> Match:
        """The step (3,) from one scan to the next, from a guess (3,) on.

        Where the guess leads to a poor overlap, rest and turns on the spot are tried as well.
        """
        best = self._align(earlier, later, guess, guess)
        if best.share < DOUBTFUL_SHARE:
            others = [self._align(earlier, later, np.array([0.0, 0.0, turn]), guess) for turn in OTHER_TURNS]
            best = max([best, *others], key=lambda match: match.share)
        return best if best.share >= LEAST_SHARE else Match(guess, True, best.share)

    def _align(self, earlier: Outline, later: Outline, start: FloatArray, guess: FloatArray) -> Match:
        """One descent by Gauss-Newton from a start; the guess stands along undetermined directions.

        Zhang, Kaess and Singh, "On Degeneracy of Optimization-based State Estimation Problems", ICRA 2016;
        but only at the end: few walls may say enough once their points have found each other.
        """
        nothing = Match(guess, True, 0.0)
        if earlier.tree is None or len(later.chosen) < FEWEST_PAIRS:
            return nothing
        points, normals = later.points[later.chosen], later.normals[later.chosen]
        step, gate = np.array(start, dtype=np.float64), self.max_distance
        for _ in range(self.max_iterations):
            turn = planar_to_poses(step[None])[0, :2, :2]
            turned = points @ turn.T
            distance, partner = earlier.tree.query(turned + step[:2], distance_upper_bound=gate)
            partner[np.isinf(distance)] = 0
            lines = earlier.normals[partner]
            paired = np.isfinite(distance) & (np.sum(lines * (normals @ turn.T), axis=1) > SAME_WALL)
            if np.count_nonzero(paired) < FEWEST_PAIRS:
                return nothing
            lines, turned, partner = lines[paired], turned[paired], partner[paired]
            residuals = np.sum((turned + step[:2] - earlier.points[partner]) * lines, axis=1)
            change, unknown = _gauss_newton(residuals, lines, turned, CALM * gate)
            step += change
            if gate == CLOSEST_GATE and (np.abs(change) < SETTLED).all():
                break
            gate = max(CLOSEST_GATE, GATE_CLOSES * gate)
        step -= unknown @ (unknown.T @ (step - guess))
        step[2] = wrap_angle(step[2])
        return Match(step, unknown.size > 0, len(residuals) / len(points))


@dataclass(frozen=True)
class ICPOptions:
    """What ``conf/model`` sets: see :class:`PointToLineICP`."""

    beams: int = option(above=0)
    max_iterations: int = option(above=0)
    max_distance: float = option(above=0)


class ICP(Model):
    """Odometry by matching each scan to the one before, without training.

    Attributes:
        failures: how many matches failed, by the name of each drive that was estimated. There the step
            before stands in their place, as a whole or along what the scans do not determine.
    """

    name = "icp"
    Options = ICPOptions

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self.matcher = PointToLineICP(sensor, **options)
        self.failures: dict[str, int] = {}

    def estimate(self, drive: Drive) -> Steps:
        """The steps of one whole drive; how far off they are is not known."""
        stepper = self.stepper()
        matches = [stepper.match(*pair) for pair in pairwise(drive.scans)]
        self.failures[drive.name] = sum(match.failed for match in matches)
        return Steps.with_unknown_covariance([match.step for match in matches])

    def stepper(self) -> "ICPStepper":
        """The same one pair of scans after the other."""
        return ICPStepper(self.matcher)


class ICPStepper:
    """Scan matching in a stream. The guess is the step before, at the beginning rest."""

    _outline: Outline

    def __init__(self, matcher: PointToLineICP) -> None:
        self.matcher, self.description = matcher, Description(matcher.sensor)
        self.reset()

    def reset(self) -> None:
        """Forgets all earlier pairs."""
        self._scan: npt.NDArray[np.float32] = np.empty(0, np.float32)
        self._guess = np.zeros(3)

    def match(self, earlier: npt.NDArray[np.float32], later: npt.NDArray[np.float32]) -> Match:
        """Matches the later of two depth vectors (bins,) to the earlier."""
        # In a stream the earlier scan is the later one of the pair before.
        same = np.array_equal(self._scan, earlier)
        outlines = self._outline if same else self.matcher.outline(earlier), self.matcher.outline(later)
        found = self.matcher.match(*outlines, self._guess)
        self._scan, self._outline, self._guess = np.array(later), outlines[1], found.step
        return found

    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """The step between two encoded scans (2, bins), the earlier first."""
        return Step(*self.match(*pair).step)


def _gauss_newton(
    residuals: FloatArray, lines: FloatArray, turned: FloatArray, calm: float
) -> tuple[FloatArray, FloatArray]:
    """The change (3,) of a step that makes distances from lines smallest, with Cauchy weights.

    Args:
        residuals: (P,) signed distances from the lines in metres.
        lines: (P, 2) their normals.
        turned: (P, 2) the points, turned as the step says and not moved yet.
        calm: metres, least scale of the weights.

    Returns:
        Metres and radians; and the directions (3, K) among them that the lines say nothing about.
    """
    scale = max(calm, 1.4826 * float(np.median(np.abs(residuals))))
    weights = 1 / (1 + (residuals / (2 * scale)) ** 2)
    levers = lines[:, 1] * turned[:, 0] - lines[:, 0] * turned[:, 1]
    jacobian = np.column_stack([lines, levers])
    weighted = jacobian * (weights / weights.sum())[:, None]
    normal_matrix = weighted.T @ jacobian
    strengths, directions = np.linalg.eigh(normal_matrix)
    change = -np.linalg.solve(normal_matrix + DAMPING * np.eye(3), weighted.T @ residuals)
    return change, directions[:, strengths < LEAST_CONSTRAINT**2]


@njit(cache=True)
def _fit_lines(points, reach, gap, closed, normals):  # type: ignore[no-untyped-def]
    """Normals (P, 2) of lines through each point's neighbours, nan where these are too few or no line.

    Args:
        points: (P, 2) in angular order, of a full circle where ``closed``.
        reach: (P,) metres to the farthest neighbour.
        gap: (P,) metres between two neighbours; more ends the line.
        closed: the last point is beside the first.
        normals: (P, 2), gets the result: unit length, towards the laser.
    """
    count = len(points)
    for i in range(count):
        x, y = points[i]
        n, sx, sy, sxx, sxy, syy = 1, 0.0, 0.0, 0.0, 0.0, 0.0
        for side in (-1, 1):
            last_u, last_v = 0.0, 0.0
            for k in range(1, min(MOST_NEIGHBOURS, count // 2) + 1):
                j = i + side * k
                if not closed and not 0 <= j < count:
                    break
                u, v = points[j % count, 0] - x, points[j % count, 1] - y
                if np.hypot(u - last_u, v - last_v) > gap[i] or np.hypot(u, v) > reach[i]:
                    break
                last_u, last_v = u, v
                n += 1
                sx, sy, sxx, sxy, syy = sx + u, sy + v, sxx + u * u, sxy + u * v, syy + v * v
        normals[i] = np.nan
        xx, xy, yy = sxx / n - (sx / n) ** 2, sxy / n - sx * sy / n**2, syy / n - (sy / n) ** 2
        middle, radius = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
        if n >= 3 and middle - radius <= STRAIGHT * (middle + radius):
            direction = np.arctan2(2 * xy, xx - yy) / 2
            across = np.array([-np.sin(direction), np.cos(direction)])
            normals[i] = -across if across[0] * x + across[1] * y > 0 else across
