"""A robot's drive through a building: errands along free paths, with turns on the spot and waits."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.indoor.building import Building
from rcnn_odom.simulation.indoor.floor import CELL, ROOM_TO_DRIVE, Floor
from rcnn_odom.simulation.street.polyline import arc_length, resample, unit

SPEED = 0.5
"""Metres per second, speed of a robot that drives straight on."""
LASER_AHEAD = 0.08
"""Metres; largest distance from the middle of a robot forward to its laser."""


@dataclass(frozen=True)
class Robot:
    """How a robot drives; values have the ranges of the logs of three robots (killian, intel, csail).

    Attributes:
        step: metres between two scans when it drives straight on.
        turn: radians between two scans when it turns on the spot.
        stops_to_turn: whether it drives straight lines and turns on the spot in between.
        winding: whether it follows the winding path of the route instead of straight lines.
        errand: approximate length of an errand in metres, after which it may stop.
        laser_ahead: metres from its middle forward to the laser.
    """

    step: float
    turn: float
    stops_to_turn: bool
    winding: bool
    errand: float
    laser_ahead: float

    @property
    def period(self) -> float:
        """Seconds between two scans."""
        return self.step / SPEED


def random_robot(rng: np.random.Generator) -> Robot:
    """A random robot with 0.5 m/s and about 45 degrees per second; its laser scans 2 to 12 times a second."""
    step = np.exp(rng.uniform(np.log(0.045), np.log(0.26)))
    stops_to_turn = rng.random() < 1 / 3
    errand = np.exp(rng.uniform(np.log(5), np.log(20 if stops_to_turn else 80)))
    return Robot(
        step=float(step),
        turn=float(step * np.deg2rad(rng.uniform(75, 110))),
        stops_to_turn=bool(stops_to_turn),
        winding=bool(not stops_to_turn and rng.random() < 0.5),
        errand=float(errand),
        laser_ahead=float(rng.uniform(0, LASER_AHEAD)),
    )


def _change_rates(robot: Robot, turn_rate_deg_s: float | None, scan_rate_hz: float | None) -> Robot:
    """The same robot with another scan rate or another turn rate; None: unchanged."""
    if scan_rate_hz is not None:
        step = SPEED / scan_rate_hz
        robot = replace(robot, step=step, turn=robot.turn / robot.step * step)
    if turn_rate_deg_s is not None:
        robot = replace(robot, turn=float(np.deg2rad(turn_rate_deg_s)) * robot.period)
    return robot


def random_walk(
    building: Building,
    frames: int,
    rng: np.random.Generator,
    turn_rate_deg_s: float | None = None,
    scan_rate_hz: float | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Simulate a robot's errands through a building.

    Args:
        building: the building; the robot keeps a distance of ``ROOM_TO_DRIVE`` from everything in it.
        frames: number of scans, 1 or more.
        rng: source of all random choices.
        turn_rate_deg_s: mean rate at which the robot turns on the spot, in degrees per second; None: a random
            rate from 37 to 55.
        scan_rate_hz: mean number of scans per second; None: a random rate from 2 to 12.

    Returns:
        x, y and heading of the laser in each frame, (N, 3), in metres and radians (not wrapped); and stamps
        (N,) in seconds, the first 0.
    """
    robot = _change_rates(random_robot(rng), turn_rate_deg_s, scan_rate_hz)
    ways = Ways.from_floor(building.floor, rng)
    course = np.array([[*ways.random_place(rng), rng.uniform(-np.pi, np.pi)]])
    waits = np.array([rng.exponential(5)])
    clock = _frames_needed(course, waits, robot)
    pace, intervals = _paces_and_intervals(frames, rng)
    instants = np.cumsum(pace * intervals)
    while clock[-1, 1] < instants[-1]:
        path = ways.random_path(course[-1, :2], robot.errand, rng)
        ahead = _plan_course(path, course[-1], building.floor, robot, rng)
        course = np.concatenate([course, ahead])
        waits = np.concatenate([waits, np.zeros(len(ahead))])
        waits[-1] = rng.exponential(8) if rng.random() < 0.5 else 0
        clock = _frames_needed(course, waits, robot)
    x, y, heading = (np.interp(instants, clock.ravel(), np.repeat(column, 2)) for column in course.T)
    heading += _heading_wobble(frames, rng)
    middle = np.stack([x, y], axis=1)
    stamps = robot.period * (np.cumsum(intervals) - intervals[0])
    return np.column_stack([middle + robot.laser_ahead * unit(heading), heading]), stamps


@dataclass(frozen=True)
class Ways:
    """A graph of paths through a building on a grid of two decimetres; wide paths cost less.

    Attributes:
        places: (P, 2) metres, points of the grid that a robot can reach.
        graph: (P, P) cost of a step between neighbouring places.
    """

    places: FloatArray
    graph: sparse.csr_array

    @classmethod
    def from_floor(cls, floor: Floor, rng: np.random.Generator) -> "Ways":
        """Build the graph of a floor, with random costs, so that robots prefer different paths."""
        free, room = floor.reachable[::2, ::2], floor.clearance[::2, ::2]
        preference = rng.uniform(0.5, 2.0, np.array(free.shape) // 8 + 1).repeat(8, 0).repeat(8, 1)
        effort = (1 + 1.5 * np.clip(0.9 - room, 0, None)) * preference[: free.shape[0], : free.shape[1]]
        number = np.cumsum(free).reshape(free.shape) - 1
        edges = []
        for x, y in ((1, 0), (0, 1), (1, 1), (1, -1)):
            here = (slice(None, -1 if x else None), slice(max(0, -y), -1 if y > 0 else None))
            there = (slice(x, None), slice(max(0, y), -1 if y < 0 else None))
            both = free[here] & free[there]
            cost = 2 * CELL * np.hypot(x, y) * (effort[here][both] + effort[there][both]) / 2
            edges.append(np.stack([cost, number[here][both], number[there][both]]))
        cost, start, end = np.concatenate(edges, axis=1)
        places = np.argwhere(free) * np.float64(2 * CELL)
        pairs = (start.astype(np.int32), end.astype(np.int32))
        graph = sparse.coo_array((cost, pairs), shape=(len(places),) * 2).tocsr()
        # On this coarser grid, small parts of the floor may be disconnected; only the largest part is kept.
        _, part = csgraph.connected_components(graph, directed=False)
        whole = np.flatnonzero(part == np.bincount(part).argmax())
        return cls(places[whole], graph[whole][:, whole])

    def random_place(self, rng: np.random.Generator) -> FloatArray:
        """A random place (2,) in metres to start from."""
        return self.places[rng.integers(len(self.places))]

    def random_path(self, start: FloatArray, effort: float, rng: np.random.Generator) -> FloatArray:
        """The cheapest path (M, 2) in metres from ``start`` to a random place with a cost near ``effort``."""
        first = ((self.places - start) ** 2).sum(axis=1).argmin()
        efforts, before = csgraph.dijkstra(
            self.graph, directed=False, indices=first, return_predecessors=True, limit=2 * effort
        )
        reached = np.where(np.isfinite(efforts), efforts, 0)
        goals = np.flatnonzero(reached >= min(effort / 2, reached.max() / 2))
        passed = [int(rng.choice(goals))]
        while passed[-1] != first:
            passed.append(int(before[passed[-1]]))
        way = self.places[passed[::-1]]
        # The start is not repeated, because a step of length 0 has no direction.
        return way if np.allclose(way[0], start) else np.concatenate([start[None], way])


def _plan_course(
    path: FloatArray, pose: FloatArray, floor: Floor, robot: Robot, rng: np.random.Generator
) -> FloatArray:
    """Plan a robot's poses along a path, and sometimes a step back or a turn on the spot at its end.

    Args:
        path: (K, 2) metres.
        pose: (3,) x, y and heading of the robot at the start of the path.
        floor: map of the floor.
        robot: the robot.
        rng: source of all random choices.

    Returns:
        Poses (M, 3): x and y in metres, heading in radians (not wrapped).
    """
    if not robot.winding:
        path = _straighten(path, floor)
    if robot.stops_to_turn:
        directions = np.arctan2(*np.diff(path, axis=0).T[::-1])
        course = np.stack([*path.repeat(2, axis=0)[1:-1].T, directions.repeat(2)], axis=1)
    else:
        path = _smooth_path(path, floor, rounds=int(rng.integers(30, 120)))
        directions = np.arctan2(*np.gradient(path, axis=0).T[::-1])
        course = np.stack([*path.T, directions], axis=1)
    course[:, 2] = np.unwrap(np.concatenate([pose[2:], course[:, 2]]))[1:]
    if rng.random() < 0.1:
        # The robot drives a short distance backwards.
        back = course[-1:].repeat(2, axis=0)
        back[1, :2] -= rng.uniform(0.2, 0.6) * unit(back[1, 2])
        if floor.room_at(_resample_evenly(back[:, :2])).min() >= ROOM_TO_DRIVE:
            course = np.concatenate([course, back[1:]])
    if robot.stops_to_turn and rng.random() < 0.7:
        # The robot turns on the spot to look around.
        course = np.concatenate([course, course[-1:] + np.array([0, 0, rng.normal(0, 2.5)])])
    return course


def _straighten(path: FloatArray, floor: Floor) -> FloatArray:
    """Replace parts of a path by straight lines that have nearly as much room."""
    room = floor.room_at(path)
    kept = [0]
    while kept[-1] < len(path) - 1:
        here = kept[-1]
        for ahead in (64, 32, 16, 8, 4, 2, 1):
            there = min(here + ahead, len(path) - 1)
            needed = max(ROOM_TO_DRIVE, 0.8 * room[here : there + 1].min())
            if ahead == 1 or floor.room_at(_resample_evenly(path[[here, there]])).min() >= needed:
                kept.append(there)
                break
    return path[kept]


def _resample_evenly(path: FloatArray) -> FloatArray:
    """Points about a decimetre apart along the lines of a path, including both ends."""
    driven = arc_length(path)
    even = np.linspace(0, driven[-1], max(2, int(driven[-1] / CELL) + 1))
    return resample(path, driven, even)


def _smooth_path(path: FloatArray, floor: Floor, rounds: int) -> FloatArray:
    """Smooth and shorten a path in several rounds; points that would come too near to a wall stay."""
    path = _resample_evenly(path)
    for _ in range(rounds):
        tighter = path.copy()
        tighter[1:-1] = (path[:-2] + 2 * path[1:-1] + path[2:]) / 4
        path = np.where((floor.room_at(tighter) >= ROOM_TO_DRIVE)[:, None], tighter, path)
    return path


def _frames_needed(course: FloatArray, waits: FloatArray, robot: Robot) -> FloatArray:
    """Times (M, 2) at which the robot arrives at each pose of its course and leaves it, in frames."""
    steps = np.diff(course, axis=0)
    needed = np.hypot(np.hypot(steps[:, 0], steps[:, 1]) / robot.step, steps[:, 2] / robot.turn)
    arrival = np.concatenate([[0], np.cumsum(needed + waits[:-1])])
    return np.stack([arrival, arrival + waits], axis=1)


def _paces_and_intervals(frames: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Relative speeds (N,) and relative intervals between scans (N,), both about 1.

    The speed drifts, the clock jitters, and some scans are lost.
    """
    drift = ndimage.gaussian_filter1d(rng.normal(size=frames), 10, mode="wrap") * np.sqrt(
        2 * np.sqrt(np.pi) * 10
    )
    stutter = np.clip(rng.normal(0, 0.12, frames), -0.5, 0.5)
    lost = rng.random(frames) < 0.01
    return np.exp(0.12 * drift), (1 + stutter) * (1 + lost)


def _heading_wobble(frames: int, rng: np.random.Generator) -> FloatArray:
    """Random deviations (N,) of the heading in radians, as on an uneven floor."""
    wobble = ndimage.gaussian_filter1d(rng.normal(size=frames), 1.5, mode="wrap")
    return np.deg2rad(rng.uniform(0.2, 1.0)) * wobble
