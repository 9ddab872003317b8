"""A network that measures what is left of a motion after a first guess (predict, warp, correct).

Both scans are drawn as surfaces, the earlier one as seen from where the guess leads
(:mod:`rcnn_odom.models.reprojection`), and the paper's six convolutions compare them. At each of their last
places the network says how far the surface there is off, in which direction it can tell, and how surely; the
residual motion is the weighted least-squares solution of all places, and its covariance the inverse of their
information. So every place is judged alike, whatever its bearing, and a direction in which nothing is seen
keeps the guess and gets a large deviation.

Training draws the guesses: any pair of scans whose motion is known gives pairs of any residual motion.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import (
    FloatArray,
    Steps,
    advance,
    compose,
    poses_to_planar,
    relative_step,
)
from rcnn_odom.models.cnn import Encoder
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.pairs import estimate_pairs
from rcnn_odom.models.reprojection import DepthVector, render_many
from rcnn_odom.models.streaming import Description, Warping
from rcnn_odom.models.trained import Batch, Recipe, State, TrainedModel
from rcnn_odom.models.uncertainty import WITHIN
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Drive

CHANNELS = 5
"""Of an image of two scans: see :func:`compare`."""
FINE = 0.05
"""Metres from which on a difference of ranges counts by its logarithm."""
NEAR = 10.0
"""Metres: the middle of the ranges, of which the logarithm is taken."""
LOG_WEIGHT, LEAST_LOG_PRIOR = (-12.0, 8.0), -4.0
"""Bounds of the logarithm of a place's weight, and of that of the prior's: fp32 cannot solve for more."""
ROUNDING = 1e-6
"""Of fp32, relative to an entry of a matrix."""
COVARIANCE_PART = 0.05
"""Of the loss, of the likelihood by which the covariances are learned."""
FROM_REST = 0.1
"""Share of the guesses in training that are no motion at all, as at the beginning of a drive."""
FARTHEST_FROM_REST, SHARPEST_FROM_REST = 3.0, 0.35
"""Metres and radians of such residual motions at most."""


@dataclass(frozen=True)
class ResidualOptions:
    """How far off the guesses are in training.

    Attributes:
        x, y: metres, standard deviations along and across the motion.
        heading_deg: degrees.
        smallest, largest: powers of ten between which each of the three deviations is scaled by itself.
    """

    x: float = option(above=0)
    y: float = option(above=0)
    heading_deg: float = option(above=0)
    smallest: float = option(fits=lambda power: -6 <= power <= 1, wanted="a number from -6 to 1")
    largest: float = option(fits=lambda power: -6 <= power <= 1, wanted="a number from -6 to 1")


@dataclass(kw_only=True)
class WarpOptions(Recipe):
    """What ``conf/model`` sets; the comments there say what each means."""

    kernel_size: int = option(fits=lambda size: size > 0 and size % 2 == 1, wanted="odd; the paper uses 3")
    pooling: str = option(choices=("avg", "max"))
    resolution_deg: float | None = option(above=0)
    passes: int = option(above=0)
    settled: float = option(least=0)
    radians_a_metre: float = option(above=0)
    key_distance: float = option(least=0)
    key_turn_deg: float = option(above=0)
    residual: ResidualOptions
    floor: float = option(above=0)


def compare(pairs: Tensor, sensor: Sensor) -> Tensor:
    """Images (N, 5, 1, bins) of drawn pairs (N, 2, bins), the guess's scan first.

    The channels: the difference of the ranges, linear up to some centimetres and logarithmic beyond; the
    logarithm of the later scan's range; its slope (the tangent of the angle at which the surface is hit);
    where the later scan sees something; where both do.

    Args:
        pairs: metres, 0 where nothing is seen.
        sensor: the bins.
    """
    before, now = pairs.unbind(-2)
    sees = now > 0
    both = sees & (before > 0)
    zero = now.new_zeros(())
    difference = torch.where(both, torch.asinh((now - before) / FINE), zero) / 2
    depth = torch.where(sees, torch.log(now.clamp(min=0.1) / NEAR), zero)
    right, middle, left = now[..., :-2], now[..., 1:-1], now[..., 2:]
    across = 2 * math.radians(sensor.resolution_deg) * middle.clamp(min=0.1)
    is_surface = (left > 0) & (middle > 0) & (right > 0)
    slope = torch.where(is_surface, torch.asinh((left - right) / across), zero) / 2
    slope = functional.pad(slope, (1, 1))  # the ends have one neighbour alone
    image = torch.stack([difference, depth, slope, sees.to(now.dtype), both.to(now.dtype)], -1)
    return image.unsqueeze(1).permute(0, 3, 1, 2)  # channels innermost in memory, as the encoder wants them


class LocalConstraints(nn.Module):
    """The residual motion as the least-squares solution of what is seen at each place.

    At place k the network gives a direction u (radial and tangential; its length is free), a lever arm l for
    the heading, a residual r and a log weight: r = u . (x, y) + l * heading. The normal equations of all
    places are solved with a prior that says that the guess is right, whose strength is learned; they are the
    Gauss-Newton step of point-to-line matching with everything in it learned. The inverse of their matrix is
    the covariance (Cholesky).

    Args:
        features: channels of the encoder's output.
        places: bins, with fractions, in whose middle each place of the encoder's output looks, (places,).
        sensor: the bins drawn.
    """

    cos: Tensor
    sin: Tensor

    def __init__(self, features: int, places: FloatArray, sensor: Sensor) -> None:
        super().__init__()
        self.constraint = nn.Conv2d(features, 5, 1)
        nn.init.normal_(self.constraint.weight, 0, 0.02)
        nn.init.zeros_(self.constraint.bias)  # type: ignore[arg-type]
        self.log_prior = nn.Parameter(torch.zeros(3))
        bearings = np.deg2rad(sensor.first_bin_deg + sensor.resolution_deg * places)
        self.register_buffer("cos", torch.from_numpy(np.cos(bearings)).float(), persistent=False)
        self.register_buffer("sin", torch.from_numpy(np.sin(bearings)).float(), persistent=False)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Motions (N, 3) and their information (N, 3, 3), in ``units``, of features (N, C, 1, places)."""
        with torch.autocast(features.device.type, enabled=False):
            radial, tangential, lever, residual, log_weight = (
                self.constraint(features.float()).squeeze(-2).unbind(1)
            )
            weight = log_weight.clamp(*LOG_WEIGHT).exp()
            rows = torch.stack(
                [
                    self.cos * radial - self.sin * tangential,
                    self.sin * radial + self.cos * tangential,
                    lever,
                ],
                1,
            )  # (N, 3, places)
            weighted = rows * weight.unsqueeze(1)
            matrix = weighted @ rows.transpose(1, 2) + torch.diag(
                self.log_prior.clamp(min=LEAST_LOG_PRIOR).exp()
            )
            motion = invert(matrix) @ (weighted @ residual.unsqueeze(-1))
            return motion.squeeze(-1), matrix


def factor(matrix: Tensor) -> tuple[Tensor, ...]:
    """The Cholesky factor of symmetric positive definite matrices (..., 3, 3), written out.

    Returns:
        Its elements (...) l11, l21, l22, l31, l32 and l33.

    Exported files have no operator for it. What rounding would make negative stays a millionth of its entry.
    """
    a, b, c, d, e, f = (matrix[..., i, j] for i, j in ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)))
    l11 = a.sqrt()
    l21, l31 = b / l11, d / l11
    l22 = torch.maximum(c - l21.square(), ROUNDING * c).sqrt()
    l32 = (e - l31 * l21) / l22
    l33 = torch.maximum(f - l31.square() - l32.square(), ROUNDING * f).sqrt()
    return l11, l21, l22, l31, l32, l33


def invert(matrix: Tensor) -> Tensor:
    """The inverse (..., 3, 3) of symmetric positive definite matrices."""
    l11, l21, l22, l31, l32, l33 = factor(matrix)
    # The inverse of the factor, below whose diagonal these stand.
    m11, m22, m33 = 1 / l11, 1 / l22, 1 / l33
    m21 = -l21 * m11 * m22
    m32 = -l32 * m22 * m33
    m31 = -(l31 * m11 + l32 * m21) * m33
    xx, xy, xh = m11.square() + m21.square() + m31.square(), m21 * m22 + m31 * m32, m31 * m33
    yy, yh, hh = m22.square() + m32.square(), m32 * m33, m33.square()
    return torch.stack([xx, xy, xh, xy, yy, yh, xh, yh, hh], -1).unflatten(-1, (3, 3))


def log_determinant(matrix: Tensor) -> Tensor:
    """The logarithm of the determinant (...) of symmetric positive definite matrices (..., 3, 3)."""
    l11, _, l22, _, _, l33 = factor(matrix)
    return 2 * (l11.log() + l22.log() + l33.log())


class ResidualNetwork(TrainedModel):
    """What measures residual motions: how it is trained, used in a drive, and calibrated.

    A subclass has :meth:`measure` and :meth:`draw`.

    Attributes:
        units: (3,) metres, metres and radians in which the head solves and the loss compares, so that all
            three count alike.
        warping: how it is used in a stream.
        typical_change: (3,) root mean square of the change of training steps, metres and radians.
        scale: (3,) by which its deviations are multiplied, fitted on validation drives; 1 before.
    """

    only_in_training: ClassVar[tuple[str, ...]] = (
        "residual",
        "floor",
        "passes",
        "settled",
        "key_distance",
        "key_turn_deg",
    )
    scale: Tensor
    typical_change: Tensor
    units: Tensor
    warping: Warping

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self.warping = Warping(**{key: options[key] for key in Warping.__dataclass_fields__})
        self.drawn = self.warping.drawn(sensor)
        self.register_buffer("scale", torch.ones(3))
        self.register_buffer("typical_change", torch.full((3,), torch.nan))
        self.register_buffer("units", torch.tensor([1.0, 1.0, options["radians_a_metre"]]), persistent=False)

    def set_units(self, steps: FloatArray) -> None:
        """Also told how much steps change."""
        super().set_units(steps)
        self.typical_change.copy_(torch.from_numpy(np.sqrt(np.square(np.diff(steps, axis=0)).mean(0))))

    def take_weights(self, model: TrainedModel) -> None:
        """Keeps how much the new steps change, too."""
        typical_change = self.typical_change.clone()
        super().take_weights(model)
        self.typical_change.copy_(typical_change)

    def describe(self) -> Description:
        """Also how it is used."""
        x, y, heading = self.typical_change.double().tolist()
        return replace(super().describe(), warping=self.warping, typical_change=(x, y, heading))

    @abstractmethod
    def measure(self, pairs: Tensor, state: State = ()) -> tuple[Tensor, Tensor, State]:
        """Residual motions of drawn pairs (B, T, 2, bins drawn).

        Returns:
            The motions (B, T, 3) and their information (B, T, 3, 3), in ``units``, and the state after them.
        """

    def forward(self, pairs: Tensor, state: State = ()) -> tuple[Tensor, Tensor, State]:
        """Residual motions of drawn pairs (B, T, 2, bins drawn), the guess's scan first.

        Returns:
            Where each later scan was taken, seen from where the guess says (B, T, 3), in metres and radians;
            covariances (B, T, 3, 3); and the state.
        """
        motion, matrix, state = self.measure(pairs, state)
        units = self.units * self.scale
        return motion * self.units, invert(matrix) * units * units.unsqueeze(-1), state

    def estimate_scans(self, scans: Tensor) -> Steps:
        """The steps of encoded scans (N, bins): as in a stream, in full precision."""
        values = scans.cpu().numpy()
        with torch.autocast(scans.device.type, enabled=False):
            return estimate_pairs(
                self.stepper(), (values[frame : frame + 2] for frame in range(len(values) - 1))
            )

    def calibrate(self, drives: Sequence[Drive]) -> None:
        """Fits the scale of the deviations as well: 68.27 % of the errors lie within one of them.

        No period is kept: what is left of a motion is measured at any rate of scans.
        """
        super().calibrate(drives)
        self.period.fill_(torch.nan)
        self.scale.fill_(1.0)
        estimates = [self.estimate(drive) for drive in drives]
        errors = np.concatenate(
            [each.values - drive.steps for each, drive in zip(estimates, drives, strict=True)]
        )
        variances = np.concatenate([np.diagonal(each.covariances, axis1=1, axis2=2) for each in estimates])
        known = np.isfinite(errors).all(1) & np.isfinite(variances).all(1)
        if not known.any():
            return
        ratios = np.abs(errors[known]) / np.sqrt(variances[known])
        self.scale.copy_(torch.from_numpy(np.maximum(np.quantile(ratios, WITHIN, axis=0), 1e-3)))

    def compare_residuals(self, motion: Tensor, matrix: Tensor, truth: Tensor) -> dict[str, Tensor]:
        """The loss of motions (N, 3) with information (N, 3, 3), in ``units``; truth (N, 3) in metres and
        radians.

        An error counts by the size of the residual motion, so that small ones are measured finely; below
        ``floor`` (in ``units``) all count alike.
        """
        truth = truth / self.units
        error = motion - truth
        relative = error.norm(dim=-1) / (truth.norm(dim=-1) + self.options["floor"])
        # Not as a product of matrices, which autocast would round to bf16.
        squares = (error.unsqueeze(-1) * matrix * error.unsqueeze(-2)).sum((-1, -2))
        likelihood = (squares - log_determinant(matrix)) / 2
        return {
            "loss": relative.mean() + COVARIANCE_PART * likelihood.mean(),
            "loss_relative": relative.mean(),
            "loss_likelihood": likelihood.mean(),
            "diverged": ~error.isfinite().all(-1),
        }

    def draw_scans(
        self,
        earlier: DepthVector,
        later: DepthVector,
        guesses: FloatArray,
        residuals: FloatArray,
        rng: np.random.Generator,
        device: torch.device,
    ) -> tuple[Tensor, Tensor]:
        """Pairs of scans as the network sees them, half of the windows mirrored where that is exact.

        Args:
            earlier, later: (..., bins) metres.
            guesses: (..., 3) where the later scan seems to have been taken, seen from the earlier one.
            residuals: (..., 3) where it was taken, seen from there.
            rng: decides which windows, of the first dimension, are mirrored.
            device: of what is returned.

        Returns:
            Drawn pairs (..., 2, bins drawn) and residuals (..., 3).
        """
        flat, threads = (-1, self.sensor.bins), torch.get_num_threads()
        viewpoints, here = guesses.reshape(-1, 3), np.zeros((residuals.size // 3, 3))
        before = render_many(earlier.reshape(flat), self.sensor, viewpoints, self.drawn, threads)
        now = render_many(later.reshape(flat), self.sensor, here, self.drawn, threads)
        pairs = np.stack([before, now], 1).reshape(*residuals.shape[:-1], 2, self.drawn.bins)
        if self.sensor.facing_deg % 180 == 0:  # the mirror image of any other laser is another laser
            mirrored = rng.random(len(pairs)) < 0.5
            pairs[mirrored] = pairs[mirrored, ..., ::-1]
            residuals[mirrored, ..., 1:] *= -1
        return torch.from_numpy(pairs).to(device), torch.from_numpy(residuals).float().to(device)

    def draw_residual(self, step: FloatArray, rng: np.random.Generator) -> FloatArray:
        """How far off a guess of a step (3,) is: (3,) in metres and radians."""
        x, y, heading = np.abs(step)
        if rng.random() < FROM_REST and max(x, y) < FARTHEST_FROM_REST and heading < SHARPEST_FROM_REST:
            return step
        options = ResidualOptions(**self.options["residual"])
        deviations = np.array([options.x, options.y, math.radians(options.heading_deg)])
        # A scale for each of the three: with one for all, the network would infer the size of one part of the
        # residual from the others, and along a corridor take a guess for right since its heading is.
        scale = 10 ** rng.uniform(options.smallest, options.largest, 3)
        drawn: FloatArray = deviations * rng.standard_normal(3) * scale
        return drawn


def windows_of(batch: Batch) -> tuple[DepthVector, FloatArray]:
    """Scans (B, T + 1, bins) of a batch of windows, and their poses (B, T + 1, 3) seen from the first.

    Raises:
        InputError: the pairs of a window do not share their scans.
    """
    if not torch.equal(batch["pairs"][:, 1:, 0], batch["pairs"][:, :-1, 1]):
        raise InputError(
            "data.augment.max_turn_deg: turns the second scan of each pair by itself; networks that draw "
            "their own guesses have no use for it; leave it out"
        )
    scans = torch.cat([batch["pairs"][:, :, 0], batch["pairs"][:, -1:, 1]], 1).cpu().numpy()
    steps = batch["steps"].double().cpu().numpy()
    return scans, np.stack([poses_to_planar(compose(each)) for each in steps])


def seeded_generator() -> np.random.Generator:
    """Draws what torch's seed says: a training that goes on so draws what it would have drawn."""
    return np.random.default_rng(int(torch.randint(2**62, ())))


class CNNWarp(ResidualNetwork):
    """The paper's encoder over a pair of drawn scans, and local constraints: no memory of its own."""

    name = "cnn_warp"
    Options = WarpOptions

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self.encoder = Encoder(self.drawn, options["kernel_size"], options["pooling"], CHANNELS)
        self.head = LocalConstraints(self.encoder.channels, self.encoder.places, self.drawn)

    def measure(self, pairs: Tensor, state: State = ()) -> tuple[Tensor, Tensor, State]:
        """Motions (B, T, 3) and their information (B, T, 3, 3), in ``units``, and the state."""
        features = self.encoder.convolve(compare(pairs.flatten(0, -3), self.drawn))
        motion, matrix = self.head(features)
        return motion.unflatten(0, pairs.shape[:-2]), matrix.unflatten(0, pairs.shape[:-2]), state

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """The error of residual motions by their size, and the likelihood that teaches the covariances."""
        pairs, residuals = self.draw(batch)
        motion, matrix, _ = self.measure(pairs.unsqueeze(1))
        return self.compare_residuals(motion[:, 0], matrix[:, 0], residuals)

    def draw(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """A pair of scans of each window with a guess: drawn pairs (B, 2, bins drawn), residuals (B, 3)."""
        scans, poses = windows_of(batch)
        rng = seeded_generator()
        chosen = np.array([rng.choice(scans.shape[1], 2, replace=False) for _ in scans])
        earlier, later = (scans[np.arange(len(scans)), which] for which in chosen.T)
        guesses, residuals = np.empty((2, len(scans), 3))
        for n, (first, second) in enumerate(chosen):
            step = relative_step(poses[n, first], poses[n, second])
            residuals[n] = self.draw_residual(step, rng)
            guesses[n] = advance(step, relative_step(residuals[n], np.zeros(3)))
        return self.draw_scans(earlier, later, guesses, residuals, rng, batch["pairs"].device)
