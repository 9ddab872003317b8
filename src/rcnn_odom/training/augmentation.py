"""Augmentation of training windows: other poses, other lasers, lost returns. The true steps stay exact."""

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

MOVE_SCALE_POWERS = -1.5, 0.35
"""Range of the power of ten that scales a window's moves: most are small, some twice the deviation."""
MIN_VISIBLE_SHARE = 0.2
"""Smallest share of a scan's returns that must remain after a move."""
MAX_HALVINGS = 8
"""Number of times that a move with too few remaining returns is halved; the last time it becomes zero."""
MAX_MOVE_SHARE = 0.25
"""Largest deviation of a move as a share of the sensor's range; scans farther apart hardly overlap."""
MAX_MOVE_TURN_DEG = 90.0
"""Largest deviation of the heading of a move."""
MIN_SPACING_BINS = 0.5
"""Smallest spacing of a beam pattern in bins; closer beams would only be averaged within a bin."""
MIN_BEAMS = 10
"""Smallest number of beams of a pattern over the field of view."""
SPACING_COUNT = 12
"""Number of spacings between the smallest and the largest; few, so that beam directions are cached."""
VELODYNE = hdl64_ring(80.0)
VELODYNE_SHARE = 0.2
"""Share of the windows with a Velodyne's irregular pattern, if its spacing is within the limits."""


class Beams(NamedTuple):
    """The beams of another laser.

    Attributes:
        grid: a sensor whose bins are centred on the beams.
        phase: angle in radians by which all beams are turned to the left.
        is_irregular: whether only some beams are fired, as by a Velodyne: mostly every second beam of the
            grid, sometimes two neighbouring ones.
    """

    grid: Sensor
    phase: float
    is_irregular: bool


@dataclass(frozen=True)
class Augmentation:
    """Changes training windows at random: ``data.augment``. The defaults change nothing.

    The random numbers depend only on the window's seed. Each window draws its own amounts, between zero and
    the given limits.

    Attributes:
        sensor: the sensor of the scans.
        mirror: mirrors half of the windows; the sampler draws which.
        max_turn_deg: largest turn in degrees of the second scan of a pair. Turns are whole bins and
            independent from pair to pair.
        move: standard deviations (metres ahead, metres to the left, degrees) of the virtual poses from which
            all scans of a window but the first are seen; None: scans keep their poses.
        max_range_scale: largest factor by which the scene is scaled up or down.
        lost_beams: largest share of returns that are lost at random.
        lost_sector_deg: width in degrees of the largest sector without returns; the same sector in all scans
            of a window.
        noise: largest standard deviation, in metres, of normal noise of the ranges.
        beam_pattern: smallest and largest spacing, in degrees, of the beams of a virtual laser that sees all
            scans of a window; None: scans keep their beams.

    Raises:
        InputError: an option does not fit the sensor.

    >>> augmentation = Augmentation(Sensor(1.0, 180.0, 40.0), max_range_scale=2.0)
    >>> scans, steps = augmentation.change(np.ones((2, 181)), np.array([[1.0, 0.0, 0.1]]), seed=0)
    >>> bool(np.isclose(scans[0, 0], steps[0, 0])), float(steps[0, 2])
    (True, 0.1)
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
        view, farthest = self.sensor.field_of_view_deg, MAX_MOVE_SHARE * self.sensor.max_range
        if self.mirror and self.sensor.facing_deg % 180:
            raise InputError(
                f"data.augment.mirror=true: the mirror image of a laser that faces "
                f"{self.sensor.facing_deg:g} degrees is another laser; leave it out"
            )
        if self.move is not None and (max(self.move[:2]) > farthest or self.move[2] > MAX_MOVE_TURN_DEG):
            raise InputError(
                f"data.augment.move={list(self.move)}: two scans would have nothing in common; at most "
                f"{farthest:g} m, a quarter of data.sensor.max_range, and {MAX_MOVE_TURN_DEG:g} degrees"
            )
        if self.lost_sector_deg >= view:
            raise InputError(
                f"data.augment.lost_sector_deg={self.lost_sector_deg:g}: is all that the sensor sees; set "
                f"less than {view:g}"
            )
        finest, widest = MIN_SPACING_BINS * self.sensor.resolution_deg, view / MIN_BEAMS
        if self.beam_pattern is not None and not (
            finest <= self.beam_pattern[0] and self.beam_pattern[1] <= widest
        ):
            raise InputError(
                f"data.augment.beam_pattern={list(self.beam_pattern)}: for this sensor from {finest:g} "
                f"degrees, half a bin, to {widest:g}, {MIN_BEAMS} beams in its field of view"
            )

    @property
    def max_turn_bins(self) -> int:
        """Largest turn of a second scan in whole bins."""
        return round(self.max_turn_deg / self.sensor.resolution_deg)

    @property
    def changes_scans(self) -> bool:
        """Whether :meth:`change` has an effect."""
        options = self.move, self.beam_pattern, self.lost_beams, self.lost_sector_deg, self.noise
        return any(options) or self.max_range_scale != 1

    def change(self, scans: DepthVectors, steps: FloatArray, seed: int) -> tuple[DepthVectors, FloatArray]:
        """Applies all changes but turns and mirror images to a window.

        The order is: the scale of the scene, so that moves and noise are metres in the scaled scene; the
        virtual poses and the virtual laser, in one rendering; noise and lost returns.

        Args:
            scans: (T + 1, bins) depth vectors in metres; not changed in place.
            steps: (T, 3) true steps in metres and radians; not changed in place.
            seed: seed of the window.

        Returns:
            The changed scans and steps, same shapes.
        """
        # The turns have a generator of their own, so that these options do not change them.
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
                scans[number], moves[number] = self._view_scan(scan, moves[number], beams, rng)
            if self.move:
                steps = moved_steps(steps, moves)
        if self.lost_beams or self.lost_sector_deg or self.noise:
            self._drop_returns_and_add_noise(scans, rng)
        return scans, steps

    def _draw_moves(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draws virtual poses (count + 1, 3) relative to the scans' own poses; the first is zero.

        The size of the moves and their correlation from scan to scan are drawn once for a window: the
        poses of some windows jump from scan to scan, and those of others drift slowly.
        """
        moves = np.zeros((count + 1, 3))
        if not self.move:
            return moves
        ahead, left, turned = self.move
        largest = 10 ** rng.uniform(*MOVE_SCALE_POWERS) * np.array([ahead, left, math.radians(turned)])
        kept = rng.uniform()
        moves[1:] = largest * rng.standard_normal((count, 3))
        for number in range(2, count + 1):
            moves[number] = kept * moves[number - 1] + math.sqrt(1 - kept**2) * moves[number]
        return moves

    def _draw_beams(self, rng: np.random.Generator) -> Beams | None:
        """Draws the virtual laser of a window; None: scans keep their beams."""
        if not self.beam_pattern:
            return None
        least, largest = self.beam_pattern
        is_irregular = least <= VELODYNE.step_deg <= largest and rng.random() < VELODYNE_SHARE
        spacing = float(least * (largest / least) ** (rng.integers(SPACING_COUNT) / (SPACING_COUNT - 1)))
        if is_irregular:
            spacing = VELODYNE.step_deg / 2
        view = self.sensor.field_of_view_deg
        if view == 360:
            spacing = view / round(view / spacing)
        else:
            view = math.floor(view / spacing) * spacing
        grid = Sensor(spacing, view, self.sensor.max_range, self.sensor.facing_deg)
        return Beams(grid, math.radians(spacing) * rng.uniform(-0.5, 0.5), is_irregular)

    def _view_scan(
        self, scan: DepthVectors, move: FloatArray, beams: Beams | None, rng: np.random.Generator
    ) -> tuple[DepthVectors, FloatArray]:
        """Views a scan (bins,) from a virtual pose (3,); halves the move while too few returns remain.

        Returns:
            The new scan (bins,) and the move (3,) that was applied.
        """
        wanted = MIN_VISIBLE_SHARE * np.count_nonzero(scan)
        if beams:  # Beams wider apart than the bins have fewer returns from any pose.
            wanted *= min(1.0, self.sensor.resolution_deg / beams.grid.resolution_deg)
        for halving in range(MAX_HALVINGS + 1):
            seen = self._render_scan(scan, move, beams, rng)
            if not move.any() or np.count_nonzero(seen) >= wanted:
                break
            move = move / 2 if halving + 1 < MAX_HALVINGS else np.zeros(3)
        return seen, move

    def _render_scan(
        self, scan: DepthVectors, move: FloatArray, beams: Beams | None, rng: np.random.Generator
    ) -> DepthVectors:
        """Renders a scan (bins,) from a virtual pose (3,) with other beams."""
        if beams is None:
            return reproject(scan, self.sensor, move) if move.any() else scan
        ranges = render(scan, self.sensor, move + np.array([0, 0, beams.phase]), beams.grid)
        is_circle = beams.grid.field_of_view_deg == 360
        if is_circle:
            ranges = ranges[:-1]
        if beams.is_irregular:
            draws = rng.random(len(ranges), np.float32)
            _keep_fired_beams(ranges, draws, VELODYNE.half_steps)
        first = beams.grid.first_bin_deg - self.sensor.first_bin_deg + math.degrees(beams.phase)
        width = self.sensor.resolution_deg
        encoded: DepthVectors = _encode_beams(
            ranges, first / width, beams.grid.resolution_deg / width, self.sensor.bins, is_circle
        )
        return encoded

    def _drop_returns_and_add_noise(self, scans: DepthVectors, rng: np.random.Generator) -> None:
        """Adds noise to the returns of scans (T + 1, bins) and removes some of them, in place."""
        distinct = self.sensor.bins - (self.sensor.field_of_view_deg == 360)
        share = rng.uniform(0, self.lost_beams)
        deviation = rng.uniform(0, self.noise)
        sector = round(rng.uniform(0, self.lost_sector_deg) / self.sensor.resolution_deg)
        first = int(rng.integers(distinct - (sector if distinct == self.sensor.bins else 0)))
        # Random numbers are drawn per return, since most bins of a fine sensor are empty.
        count = np.count_nonzero(scans)
        draws = rng.random(count if share else 0, np.float32)
        errors = rng.standard_normal(count if deviation else 0, np.float32)
        errors *= np.float32(deviation)
        _add_noise_and_drop(
            scans, distinct, draws, np.float32(share), errors, first, sector, self.sensor.max_range
        )


def moved_steps(steps: FloatArray, moves: FloatArray) -> FloatArray:
    """Steps (T, 3) between virtual poses.

    Args:
        steps: (T, 3) steps between the scans' own poses, metres and radians.
        moves: (T + 1, 3) virtual poses, each in the frame of its scan, metres and radians.

    >>> ahead = np.array([[1.0, 0.0, 0.0]])
    >>> moved_steps(ahead, np.array([[0.0, 0.0, np.pi / 2], [0.5, 0.0, 0.0]])).round(6).tolist()
    [[0.0, -1.5, -1.570796]]
    """
    pairs = zip(moves[:-1], steps, moves[1:], strict=True)
    return np.stack([relative_step(before, advance(step, after)) for before, step, after in pairs])


@compiled
def _keep_fired_beams(ranges, draws, half_steps):  # type: ignore[no-untyped-def]
    """Sets ranges (B,) of beams that a Velodyne would not fire to 0; ``draws`` (B,) are in [0, 1).

    Neighbouring beams are half a step of the Velodyne apart.
    """
    following, shots = 0, 0
    for beam in range(len(ranges)):
        if beam == following:
            following += 1 if draws[shots] < half_steps else 2
            shots += 1
        else:
            ranges[beam] = 0


@compiled
def _encode_beams(ranges, first, spacing, bins, is_circle):  # type: ignore[no-untyped-def]
    """Encodes ranges (B,) as mean depths (bins,); a range or depth of 0 is no return.

    Args:
        ranges: metres.
        first: direction of the first beam in bins.
        spacing: angle between the beams in bins.
        bins: number of bins.
        is_circle: whether the last bin repeats the first.
    """
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
def _add_noise_and_drop(scans, distinct, draws, share, errors, first, sector, max_range):  # type: ignore[no-untyped-def]
    """Adds errors to returns of scans (T + 1, bins); drops those with a draw below ``share``, and a sector.

    Args:
        scans: changed in place.
        distinct: number of bins without the repeated last one of a full circle.
        draws: one number in [0, 1) for each return, in order; or empty.
        share: share of the returns that are dropped.
        errors: metres, one for each return, in order; or empty.
        first: first bin of the sector.
        sector: width of the sector in bins.
        max_range: metres; a range beyond it becomes empty.
    """
    number = 0
    for scan in scans:
        for k in range(distinct):
            if scan[k] > 0:
                if len(errors):
                    scan[k] += errors[number]
                    if not 0 < scan[k] < max_range:
                        scan[k] = 0
                if len(draws) and draws[number] < share:
                    scan[k] = 0
                number += 1
        for k in range(first, first + sector):
            scan[k % distinct] = 0
        if distinct < len(scan):
            scan[distinct] = scan[0]
