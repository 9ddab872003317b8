"""A robot's drive through a building: errands along free ways, with turns, waits and looks round."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.indoor.building import Building
from rcnn_odom.simulation.indoor.floor import CELL, ROOM_TO_DRIVE, Floor
from rcnn_odom.simulation.street.polyline import arc_length, resample, unit

SPEED = 0.5
"""Metres a second of the three robots when they drive straight on."""
LASER_AHEAD = 0.08
"""Metres between the middle of a robot and its laser, at most."""


@dataclass(frozen=True)
class Robot:
    """How a robot drives; ranges are those of three real robots' logs (killian, intel, csail).

    Attributes:
        step: metres between two scans when it drives straight on.
        turn: radians between two scans when it turns on the spot.
        stops_to_turn: whether it drives straight lines and turns on the spot in between.
        winding: whether it takes bends where a straight line would do.
        errand: metres that it likes to go before it stops.
        laser_ahead: metres from its middle to the laser.
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
    """A robot of about half a metre and 45 degrees a second, whose laser scans twice to 12 times a second."""
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


def _at_rates(robot: Robot, turn_rate_deg_s: float | None, scan_rate_hz: float | None) -> Robot:
    """The same robot with another laser's rate, and turning faster or slower."""
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
    """A robot's errands through a building.

    Args:
        building: where; the robot keeps ``ROOM_TO_DRIVE`` from all that stands in it.
        frames: scans, 1 or more.
        rng: where all chance comes from.
        turn_rate_deg_s: how fast the robot turns on the spot, but for the drift of its pace; None: at its own
            rate, 37 to 55 degrees a second.
        scan_rate_hz: scans a second, but for its clock's stutter; None: its own, 2 to 12.

    Returns:
        x, y and heading of the laser in every frame, (N, 3), metres and radians (not wrapped), and the
        frames' stamps (N,) in seconds, the first 0.
    """
    robot = _at_rates(random_robot(rng), turn_rate_deg_s, scan_rate_hz)
    ways = Ways.of(building.floor, rng)
    course = np.array([[*ways.anywhere(rng), rng.uniform(-np.pi, np.pi)]])
    waits = np.array([rng.exponential(5)])
    clock = _frames_needed(course, waits, robot)
    pace, intervals = _paces_and_intervals(frames, rng)
    instants = np.cumsum(pace * intervals)
    while clock[-1, 1] < instants[-1]:
        path = ways.way(course[-1, :2], robot.errand, rng)
        ahead = _follow(path, course[-1], building.floor, robot, rng)
        course = np.concatenate([course, ahead])
        waits = np.concatenate([waits, np.zeros(len(ahead))])
        waits[-1] = rng.exponential(8) if rng.random() < 0.5 else 0
        clock = _frames_needed(course, waits, robot)
    x, y, heading = (np.interp(instants, clock.ravel(), np.repeat(column, 2)) for column in course.T)
    heading += _unsteady(frames, rng)
    middle = np.stack([x, y], axis=1)
    stamps = robot.period * (np.cumsum(intervals) - intervals[0])
    return np.column_stack([middle + robot.laser_ahead * unit(heading), heading]), stamps


@dataclass(frozen=True)
class Ways:
    """Ways through a building on a grid of two decimetres; wide ones are liked better.

    Attributes:
        places: (P, 2) metres.
        graph: (P, P) the effort of a step from place to place.
    """

    places: FloatArray
    graph: sparse.csr_array

    @classmethod
    def of(cls, floor: Floor, rng: np.random.Generator) -> "Ways":
        """The ways of a floor; ``rng`` decides where this robot likes to drive."""
        free, room = floor.reachable[::2, ::2], floor.clearance[::2, ::2]
        taste = rng.uniform(0.5, 2.0, np.array(free.shape) // 8 + 1).repeat(8, 0).repeat(8, 1)
        effort = (1 + 1.5 * np.clip(0.9 - room, 0, None)) * taste[: free.shape[0], : free.shape[1]]
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
        # On the coarser grid a nook or two may have been cut off.
        _, part = csgraph.connected_components(graph, directed=False)
        whole = np.flatnonzero(part == np.bincount(part).argmax())
        return cls(places[whole], graph[whole][:, whole])

    def anywhere(self, rng: np.random.Generator) -> FloatArray:
        """A place to start from."""
        return self.places[rng.integers(len(self.places))]

    def way(self, start: FloatArray, effort: float, rng: np.random.Generator) -> FloatArray:
        """The easiest way (M, 2) from ``start`` to a random place about ``effort`` away."""
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
        # A step of no length would have no direction.
        return way if np.allclose(way[0], start) else np.concatenate([start[None], way])


def _follow(
    path: FloatArray, pose: FloatArray, floor: Floor, robot: Robot, rng: np.random.Generator
) -> FloatArray:
    """Poses (M, 3) along a path, from the robot's pose on, and what it does at the end of it."""
    if not robot.winding:
        path = _straighten(path, floor)
    if robot.stops_to_turn:
        directions = np.arctan2(*np.diff(path, axis=0).T[::-1])
        course = np.stack([*path.repeat(2, axis=0)[1:-1].T, directions.repeat(2)], axis=1)
    else:
        path = _round_off(path, floor, rounds=int(rng.integers(30, 120)))
        directions = np.arctan2(*np.gradient(path, axis=0).T[::-1])
        course = np.stack([*path.T, directions], axis=1)
    course[:, 2] = np.unwrap(np.concatenate([pose[2:], course[:, 2]]))[1:]
    if rng.random() < 0.1:
        # Backs off a little the way that it came.
        back = course[-1:].repeat(2, axis=0)
        back[1, :2] -= rng.uniform(0.2, 0.6) * unit(back[1, 2])
        if floor.room_at(_evenly(back[:, :2])).min() >= ROOM_TO_DRIVE:
            course = np.concatenate([course, back[1:]])
    if robot.stops_to_turn and rng.random() < 0.7:
        # Looks round.
        course = np.concatenate([course, course[-1:] + np.array([0, 0, rng.normal(0, 2.5)])])
    return course


def _straighten(path: FloatArray, floor: Floor) -> FloatArray:
    """Short cuts along straight lines, none of them tighter than the way that it replaces."""
    room = floor.room_at(path)
    kept = [0]
    while kept[-1] < len(path) - 1:
        here = kept[-1]
        for ahead in (64, 32, 16, 8, 4, 2, 1):
            there = min(here + ahead, len(path) - 1)
            needed = max(ROOM_TO_DRIVE, 0.8 * room[here : there + 1].min())
            if ahead == 1 or floor.room_at(_evenly(path[[here, there]])).min() >= needed:
                kept.append(there)
                break
    return path[kept]


def _evenly(path: FloatArray) -> FloatArray:
    """Points about a decimetre apart along straight lines, both ends included."""
    driven = arc_length(path)
    even = np.linspace(0, driven[-1], max(2, int(driven[-1] / CELL) + 1))
    return resample(path, driven, even)


def _round_off(path: FloatArray, floor: Floor, rounds: int) -> FloatArray:
    """The path pulled tight like a band that no wall lets come too near."""
    path = _evenly(path)
    for _ in range(rounds):
        tighter = path.copy()
        tighter[1:-1] = (path[:-2] + 2 * path[1:-1] + path[2:]) / 4
        path = np.where((floor.room_at(tighter) >= ROOM_TO_DRIVE)[:, None], tighter, path)
    return path


def _frames_needed(course: FloatArray, waits: FloatArray, robot: Robot) -> FloatArray:
    """When the robot arrives at every pose of its course and when it leaves, (M, 2), in frames."""
    steps = np.diff(course, axis=0)
    needed = np.hypot(np.hypot(steps[:, 0], steps[:, 1]) / robot.step, steps[:, 2] / robot.turn)
    arrival = np.concatenate([[0], np.cumsum(needed + waits[:-1])])
    return np.stack([arrival, arrival + waits], axis=1)


def _paces_and_intervals(frames: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Robots' speeds drift, clocks stutter and scans get lost: speed and time between scans, both about 1."""
    drift = ndimage.gaussian_filter1d(rng.normal(size=frames), 10, mode="wrap") * np.sqrt(
        2 * np.sqrt(np.pi) * 10
    )
    stutter = np.clip(rng.normal(0, 0.12, frames), -0.5, 0.5)
    lost = rng.random(frames) < 0.01
    return np.exp(0.12 * drift), (1 + stutter) * (1 + lost)


def _unsteady(frames: int, rng: np.random.Generator) -> FloatArray:
    """Radians by which the heading strays: no floor is even."""
    wobble = ndimage.gaussian_filter1d(rng.normal(size=frames), 1.5, mode="wrap")
    return np.deg2rad(rng.uniform(0.2, 1.0)) * wobble
