"""Augmentation of training windows that leaves their true steps exact: other ways, other lasers, losses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rcnn_odom.compiled import compiled
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, advance, relative_step
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.reprojection import render, reproject
from rcnn_odom.simulation.laser import hdl64_ring

DepthVectors = npt.NDArray[np.float32]

MOVES = -1.5, 0.35
"""Powers of ten between which a window's moves are multiplied: most are small, some twice the deviation."""
LEAST_SEEN = 0.2
"""Share of a scan's returns that must still be there after a move."""
MOST_HALVINGS = 8
"""Of a move that leaves too little; the next one is none."""
FARTHEST_MOVE = 0.25
"""Of the sensor's range, for the deviation of a move: farther off, two scans have nothing in common."""
MOST_TURNED_DEG = 90.0
"""Deviation of a move's heading at most."""
FINEST_BEAMS = 0.5
"""Bins between the beams of a pattern at least: closer ones would only be averaged."""
FEWEST_BEAMS = 10
"""Of a pattern, over the field of view."""
SPACINGS = 12
"""From the least to the largest: so few that where their beams point is not computed for every window."""
VELODYNE = hdl64_ring(80.0)
VELODYNE_SHARE = 0.2
"""Windows that have its irregular pattern, where its spacing is among those that are asked for."""


class Beams(NamedTuple):
    """The beams of another laser.

    Attributes:
        grid: with a beam in the middle of each bin.
        phase: radians by which all of them are turned to the left.
        is_irregular: only some are shot, as a Velodyne does: one in two, and now and then the next one.
    """

    grid: Sensor
    phase: float
    is_irregular: bool


@dataclass(frozen=True)
class Augmentation:
    """What happens to the windows of a training: ``data.augment``. With the defaults nothing does.

    Draws depend on the window's seed alone. Amounts are drawn for each window, from nothing up to what is
    asked for.

    Attributes:
        sensor: of the scans.
        mirror: every other window is mirrored; the sampler draws which.
        max_turn_deg: the second scan of each pair is turned by up to so many degrees, whole bins, each pair
            for itself.
        move: deviations in metres ahead, metres to the left and degrees of the places from which the scans
            after a window's first one are seen; None: from where they were taken.
        max_range_scale: the scene is up to so many times larger or smaller.
        lost_beams: share of the returns that are lost at random, at most.
        lost_sector_deg: widest sector without returns, in all scans of a window the same.
        noise: metres, the largest deviation of normal noise of the ranges.
        beam_pattern: least and largest degrees between the beams of the lasers that all scans of a window are
            seen with; None: as they are.
    """

    sensor: Sensor
    mirror: bool = False
    max_turn_deg: float = 0.0
    move: Sequence[float] | None = None
    max_range_scale: float = 1.0
    lost_beams: float = 0.0
    lost_sector_deg: float = 0.0
    noise: float = 0.0
    beam_pattern: Sequence[float] | None = None

    def __post_init__(self) -> None:
        view, farthest = self.sensor.field_of_view_deg, FARTHEST_MOVE * self.sensor.max_range
        if self.mirror and self.sensor.facing_deg % 180:
            raise InputError(
                f"data.augment.mirror=true: the mirror image of a laser that faces "
                f"{self.sensor.facing_deg:g} degrees is another laser; leave it out"
            )
        if self.move is not None and (max(self.move[:2]) > farthest or self.move[2] > MOST_TURNED_DEG):
            raise InputError(
                f"data.augment.move={list(self.move)}: two scans would have nothing in common; at most "
                f"{farthest:g} m, a quarter of data.sensor.max_range, and {MOST_TURNED_DEG:g} degrees"
            )
        if self.lost_sector_deg >= view:
            raise InputError(
                f"data.augment.lost_sector_deg={self.lost_sector_deg:g}: is all that the sensor sees; set "
                f"less than {view:g}"
            )
        finest, widest = FINEST_BEAMS * self.sensor.resolution_deg, view / FEWEST_BEAMS
        if self.beam_pattern is not None and not (
            finest <= self.beam_pattern[0] and self.beam_pattern[1] <= widest
        ):
            raise InputError(
                f"data.augment.beam_pattern={list(self.beam_pattern)}: for this sensor from {finest:g} "
                f"degrees, half a bin, to {widest:g}, {FEWEST_BEAMS} beams in its field of view"
            )

    @property
    def max_turn_bins(self) -> int:
        """Whole bins by which a second scan is turned at most."""
        return round(self.max_turn_deg / self.sensor.resolution_deg)

    @property
    def is_of_scans(self) -> bool:
        """Whether :meth:`change` changes anything."""
        options = self.move, self.beam_pattern, self.lost_beams, self.lost_sector_deg, self.noise
        return any(options) or self.max_range_scale != 1

    def change(self, scans: DepthVectors, steps: FloatArray, seed: int) -> tuple[DepthVectors, FloatArray]:
        """A window's scans and steps with all but turns and mirror images; the given ones stay as they are.

        In this order: the scene's scale, so that moves and noise are metres of what is seen; the places from
        which it is seen, and the laser, in one; lost returns; noise.

        Args:
            scans: (T + 1, bins) metres.
            steps: (T, 3) metres and radians.
            seed: of the window.
        """
        # Not the generator of the turns, which so are the same with and without these.
        rng = np.random.default_rng([seed, 1])
        scans, steps = np.array(scans), np.array(steps)
        if self.max_range_scale != 1:
            factor = self.max_range_scale ** rng.uniform(-1, 1)
            scans *= np.float32(factor)
            scans[scans >= self.sensor.max_range] = 0
            steps[:, :2] *= factor
        if self.move or self.beam_pattern:
            beams, moves = self._draw_beams(rng), self._draw_moves(len(steps), rng)
            for number, scan in enumerate(scans):
                scans[number], moves[number] = self._see(scan, moves[number], beams, rng)
            if self.move:
                steps = moved_steps(steps, moves)
        if self.lost_beams or self.lost_sector_deg or self.noise:
            self._lose(scans, rng)
        return scans, steps

    def _draw_moves(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Where the scans of a window are seen from (count + 1, 3): the first from its own place.

        How large the moves are, and how much of each is left in the next one, is drawn for the whole window:
        some shake from scan to scan, others drift.
        """
        moves = np.zeros((count + 1, 3))
        if not self.move:
            return moves
        ahead, left, turned = self.move
        largest = 10 ** rng.uniform(*MOVES) * np.array([ahead, left, math.radians(turned)])
        kept = rng.uniform()
        moves[1:] = largest * rng.standard_normal((count, 3))
        for number in range(2, count + 1):
            moves[number] = kept * moves[number - 1] + math.sqrt(1 - kept**2) * moves[number]
        return moves

    def _draw_beams(self, rng: np.random.Generator) -> Beams | None:
        """The beams of a window; None: those of its scans."""
        if not self.beam_pattern:
            return None
        least, largest = self.beam_pattern
        is_irregular = least <= VELODYNE.step_deg <= largest and rng.random() < VELODYNE_SHARE
        spacing = float(least * (largest / least) ** (rng.integers(SPACINGS) / (SPACINGS - 1)))
        if is_irregular:
            spacing = VELODYNE.step_deg / 2
        view = self.sensor.field_of_view_deg
        if view == 360:
            spacing = view / round(view / spacing)
        else:
            view = math.floor(view / spacing) * spacing
        grid = Sensor(spacing, view, self.sensor.max_range, self.sensor.facing_deg)
        return Beams(grid, math.radians(spacing) * rng.uniform(-0.5, 0.5), is_irregular)

    def _see(
        self, scan: DepthVectors, move: FloatArray, beams: Beams | None, rng: np.random.Generator
    ) -> tuple[DepthVectors, FloatArray]:
        """A scan (bins,) as seen from another place, and that (3,): half as far as long as little is left."""
        wanted = LEAST_SEEN * np.count_nonzero(scan)
        if beams:  # wider apart than the bins, they see less from wherever it is
            wanted *= min(1.0, self.sensor.resolution_deg / beams.grid.resolution_deg)
        for halving in range(MOST_HALVINGS + 1):
            seen = self._look(scan, move, beams, rng)
            if not move.any() or np.count_nonzero(seen) >= wanted:
                break
            move = move / 2 if halving + 1 < MOST_HALVINGS else np.zeros(3)
        return seen, move

    def _look(
        self, scan: DepthVectors, move: FloatArray, beams: Beams | None, rng: np.random.Generator
    ) -> DepthVectors:
        if beams is None:
            return reproject(scan, self.sensor, move) if move.any() else scan
        ranges = render(scan, self.sensor, move + np.array([0, 0, beams.phase]), beams.grid)
        is_circle = beams.grid.field_of_view_deg == 360
        if is_circle:
            ranges = ranges[:-1]
        if beams.is_irregular:
            luck = rng.random(len(ranges), np.float32)
            _keep_shots(ranges, luck, VELODYNE.half_steps)
        first = beams.grid.first_bin_deg - self.sensor.first_bin_deg + math.degrees(beams.phase)
        width = self.sensor.resolution_deg
        encoded: DepthVectors = _encode_beams(
            ranges, first / width, beams.grid.resolution_deg / width, self.sensor.bins, is_circle
        )
        return encoded

    def _lose(self, scans: DepthVectors, rng: np.random.Generator) -> None:
        """Takes returns out of scans (T + 1, bins), and adds noise to the others."""
        distinct = self.sensor.bins - (self.sensor.field_of_view_deg == 360)
        share = rng.uniform(0, self.lost_beams)
        deviation = rng.uniform(0, self.noise)
        sector = round(rng.uniform(0, self.lost_sector_deg) / self.sensor.resolution_deg)
        first = int(rng.integers(distinct - (sector if distinct == self.sensor.bins else 0)))
        # One for each return: most bins of a fine sensor have none.
        count = np.count_nonzero(scans)
        luck = rng.random(count if share else 0, np.float32)
        errors = rng.standard_normal(count if deviation else 0, np.float32)
        errors *= np.float32(deviation)
        _spoil(scans, distinct, luck, np.float32(share), errors, first, sector, self.sensor.max_range)


def moved_steps(steps: FloatArray, moves: FloatArray) -> FloatArray:
    """The steps (T, 3) between the places (T + 1, 3) that are seen from those of the scans.

    >>> ahead = np.array([[1.0, 0.0, 0.0]])
    >>> moved_steps(ahead, np.array([[0.0, 0.0, np.pi / 2], [0.5, 0.0, 0.0]])).round(6).tolist()
    [[0.0, -1.5, -1.570796]]
    """
    pairs = zip(moves[:-1], steps, moves[1:], strict=True)
    return np.stack([relative_step(before, advance(step, after)) for before, step, after in pairs])


@compiled
def _keep_shots(ranges, luck, half_steps):  # type: ignore[no-untyped-def]
    """Takes out those of beams (B,), half steps of a Velodyne, that it does not shoot; luck is (B,)."""
    following, shots = 0, 0
    for beam in range(len(ranges)):
        if beam == following:
            following += 1 if luck[shots] < half_steps else 2
            shots += 1
        else:
            ranges[beam] = 0


@compiled
def _encode_beams(ranges, first, spacing, bins, is_circle):  # type: ignore[no-untyped-def]
    """Mean depth (bins,) of beams (B,) of a first place and a spacing in bins; 0 is no return."""
    distinct = bins - 1 if is_circle else bins
    total, number = np.zeros(distinct), np.zeros(distinct)
    for beam in range(len(ranges)):
        if ranges[beam] > 0:
            k = math.floor(first + beam * spacing + (0.5 + 1e-9))
            if is_circle and (k < 0 or k >= distinct):
                k %= distinct
            if 0 <= k < distinct:
                total[k] += ranges[beam]
                number[k] += 1
    depth = np.zeros(bins, np.float32)
    for k in range(distinct):
        if number[k]:
            depth[k] = total[k] / number[k]
    if is_circle:
        depth[distinct] = depth[0]
    return depth


@compiled
def _spoil(scans, distinct, luck, share, errors, first, sector, max_range):  # type: ignore[no-untyped-def]
    """Takes out the returns of scans (T + 1, bins) whose luck is less than a share, and a sector of bins.

    Luck and errors are those of the returns, in order; one of them may be empty.
    """
    number = 0
    for scan in scans:
        for k in range(distinct):
            if scan[k] > 0:
                if len(errors):
                    scan[k] += errors[number]
                    if not 0 < scan[k] < max_range:
                        scan[k] = 0
                if len(luck) and luck[number] < share:
                    scan[k] = 0
                number += 1
        for k in range(first, first + sector):
            scan[k % distinct] = 0
        if distinct < len(scan):
            scan[distinct] = scan[0]
