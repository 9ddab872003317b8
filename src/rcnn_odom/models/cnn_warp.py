"""A network that measures the residual motion: the difference between a guessed and the true motion.

Both scans are rendered as surfaces, the earlier one from the guessed pose of the later one
(:mod:`rcnn_odom.models.reprojection`), and the paper's six convolutions compare them. For each position of
their output, which covers a sector of bearings, the network gives one linear constraint: a direction, the
offset of the surface along it, and a weight. The residual motion is the weighted least-squares solution of
all constraints, and its covariance is the inverse of their information matrix. The same weights apply at all
bearings. In a direction that no surface constrains, the guess remains and the deviation is large.

In training, the guesses are random: a pair of scans with a known motion can have any residual motion.
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
from rcnn_odom.models.pairs import estimate_encoded
from rcnn_odom.models.reprojection import DepthVector, render_many
from rcnn_odom.models.streaming import Description, Warping
from rcnn_odom.models.trained import Batch, Recipe, State, TrainedModel
from rcnn_odom.models.uncertainty import WITHIN_DEVIATION
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Drive

CHANNELS = 5
"""Number of channels of the image of two scans, see :func:`compare`."""
LINEAR_BELOW = 0.05
"""Metres; below this, the image is linear in a difference of ranges, and above this logarithmic."""
TYPICAL_RANGE = 10.0
"""Metres; a typical range, at which the logarithm of the range is 0 in the image."""
LOG_WEIGHT_BOUNDS, LEAST_LOG_PRIOR = (-12.0, 8.0), -4.0
"""Bounds of the logarithm of a constraint's weight, and the lower bound of that of the prior's weights.

Outside these bounds, fp32 is not accurate enough to solve the normal equations.
"""
RANGES_A_PLACE = 8
"""Number of bins, evenly spread, whose mean range gives the lever arm of a constraint."""
ROUNDING = 1e-6
"""Relative rounding error of a matrix entry in fp32."""
LIKELIHOOD_WEIGHT = 0.05
"""Weight of the likelihood in the loss; the covariances are learned from it."""
FITS, FITTED, CONVERGING = 8, 0.03, 0.9
"""The scale of the covariances is fitted so many times at most, until the logarithm of its correction is
smaller than the second value, and only while a correction is smaller than this fraction of the one before."""
REST_FRACTION = 0.1
"""Fraction of the training guesses that assume no motion, as at the beginning of a drive."""
LARGEST_REST_DISTANCE, LARGEST_REST_TURN = 3.0, 0.35
"""Metres and radians; a training guess assumes no motion only if the true motion is smaller than these."""


@dataclass(frozen=True)
class ResidualOptions:
    """Distribution of the residual motions in training.

    Attributes:
        x, y: standard deviations in metres, ahead and to the left.
        heading_deg: standard deviation in degrees.
        smallest, largest: each deviation is multiplied by a random power of ten, whose exponent lies between
            these two numbers.
    """

    x: float = option(above=0)
    y: float = option(above=0)
    heading_deg: float = option(above=0)
    smallest: float = option(fits=lambda power: -6 <= power <= 1, wanted="a number from -6 to 1")
    largest: float = option(fits=lambda power: -6 <= power <= 1, wanted="a number from -6 to 1")


@dataclass(kw_only=True)
class WarpOptions(Recipe):
    """The options of ``conf/model/cnn_warp.yaml``, whose comments explain them."""

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
    """The network's input images (N, 5, 1, bins) of pairs of rendered scans.

    The channels are: the difference of the ranges, linear up to some centimetres and logarithmic beyond; the
    logarithm of the later scan's range; the slope of the later scan's surface (the tangent of the angle of
    incidence, compressed by asinh); 1 where the later scan has a return; 1 where both scans have one.

    Args:
        pairs: (N, 2, bins) metres, 0 without a return; the earlier scan, seen from the guess, is the first.
        sensor: defines the bins.

    Example:
        >>> pairs = torch.full((1, 2, 5), 10.0)
        >>> compare(pairs, Sensor(resolution_deg=90.0))[0, :, 0, 0].tolist()
        [0.0, 0.0, 0.0, 1.0, 1.0]
    """
    before, now = pairs.unbind(-2)
    has_return = now > 0
    both = has_return & (before > 0)
    zero = now.new_zeros(())
    difference = torch.where(both, torch.asinh((now - before) / LINEAR_BELOW), zero) / 2
    depth = torch.where(has_return, torch.log(now.clamp(min=0.1) / TYPICAL_RANGE), zero)
    right, middle, left = now[..., :-2], now[..., 1:-1], now[..., 2:]
    across = 2 * math.radians(sensor.resolution_deg) * middle.clamp(min=0.1)
    is_surface = (left > 0) & (middle > 0) & (right > 0)
    slope = torch.where(is_surface, torch.asinh((left - right) / across), zero) / 2
    slope = functional.pad(slope, (1, 1))  # the first and the last bin have only one neighbour
    image = torch.stack([difference, depth, slope, has_return.to(now.dtype), both.to(now.dtype)], -1)
    return image.unsqueeze(1).permute(0, 3, 1, 2)  # channels innermost in memory, for the encoder's layout


class LocalConstraints(nn.Module):
    """The residual motion as the weighted least-squares solution of one constraint at each position.

    At each position of the encoder's output the network gives a direction u (its radial and tangential parts,
    of any length), a residual r and a logarithmic weight. The constraint is r = u . (x, y) + l * heading. The
    lever arm l of the heading is the tangential part times the range of the surface there: turning the laser
    moves a point at that range sideways by so much. The weight counts as far as both scans have returns
    there, so that a position where nothing is seen says nothing. A prior with learned weights pulls the
    solution towards zero, i.e. towards the guess. The normal equations are those of a Gauss-Newton step of
    point-to-line matching, but directions, residuals and weights are learned. The inverse of their matrix is
    the covariance.

    Args:
        features: channels of the encoder's output.
        places: (places,) centre of each output position, in bins, with fractions.
        sensor: defines the bins of the rendered scans.
        radians_a_metre: unit of the heading, in radians.
    """

    cos: Tensor
    sin: Tensor
    near: Tensor

    def __init__(self, features: int, places: FloatArray, sensor: Sensor, radians_a_metre: float) -> None:
        super().__init__()
        self.radians_a_metre = radians_a_metre
        self.constraint = nn.Conv2d(features, 4, 1)
        nn.init.normal_(self.constraint.weight, 0, 0.02)
        # Before training, every constraint is radial. From tiny random directions, some trainings never learn
        # to measure the heading (docs/warp.md).
        assert self.constraint.bias is not None
        self.constraint.bias.data.copy_(torch.tensor([1.0, 0.0, 0.0, 0.0]))
        self.log_prior = nn.Parameter(torch.zeros(3))
        bearings = np.deg2rad(sensor.first_bin_deg + sensor.resolution_deg * places)
        spread = (np.arange(RANGES_A_PLACE) + 0.5) / RANGES_A_PLACE - 0.5
        width = np.diff(places).mean() if len(places) > 1 else sensor.bins
        near = np.rint(places[:, None] + width * spread)
        # The last bin of a full circle is the first one again.
        is_circle = sensor.field_of_view_deg == 360
        near = near % (sensor.bins - 1) if is_circle else near.clip(0, sensor.bins - 1)
        self.register_buffer("cos", torch.from_numpy(np.cos(bearings)).float(), persistent=False)
        self.register_buffer("sin", torch.from_numpy(np.sin(bearings)).float(), persistent=False)
        self.register_buffer("near", torch.from_numpy(near).long(), persistent=False)

    def forward(self, features: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor]:
        """Solves for the residual motions.

        Args:
            features: (N, C, 1, places) output of the encoder.
            pairs: (N, 2, bins) the rendered scans in metres, 0 without a return; the earlier is the first.

        Returns:
            Motions (N, 3) and their information matrices (N, 3, 3), in :attr:`ResidualNetwork.units`.
        """
        with torch.autocast(features.device.type, enabled=False):
            constraint = self.constraint(features.float()).squeeze(-2)  # (N, 4, places)
            radial, tangential, residual, log_weight = constraint.split(1, 1)
            ranges, share = self.find_ranges_and_shares(pairs)
            weight = log_weight.clamp(*LOG_WEIGHT_BOUNDS).exp() * share
            rows = torch.cat(
                [
                    self.cos * radial - self.sin * tangential,
                    self.sin * radial + self.cos * tangential,
                    tangential * ranges * self.radians_a_metre,
                ],
                1,
            )  # (N, 3, places)
            weighted = rows * weight
            matrix = weighted @ rows.transpose(1, 2) + torch.diag(
                self.log_prior.clamp(min=LEAST_LOG_PRIOR).exp()
            )
            motion = invert(matrix) @ (weighted @ residual.transpose(1, 2))
            return motion.squeeze(-1), matrix

    def find_ranges_and_shares(self, pairs: Tensor) -> tuple[Tensor, Tensor]:
        """What pairs of scans (N, 2, bins) have around each position.

        Returns:
            The mean range (N, 1, places) of the later scan in metres, 0 without a return, and the share
            (N, 1, places) of the bins in which both scans have a return.
        """
        near = pairs[..., self.near]  # (N, 2, places, RANGES_A_PLACE)
        now = near[:, 1:]
        ranges = now.sum(-1) / (now > 0).sum(-1).clamp(min=1)
        return ranges, (near.amin(1, keepdim=True) > 0).float().mean(-1)


def factor(matrix: Tensor) -> tuple[Tensor, ...]:
    """The Cholesky factors of symmetric positive definite matrices (..., 3, 3).

    They are computed element by element, because ONNX has no operator for them. The elements keep a last
    dimension of 1, which saves the exported graph the nodes that drop and add it. Pivots that rounding errors
    would make negative are replaced by a millionth of the diagonal entry.

    Returns:
        The elements l11, l21, l22, l31, l32 and l33 of the factors, each of shape (..., 1).

    Example:
        >>> [float(element) for element in factor(torch.diag(torch.tensor([4.0, 9.0, 16.0])))]
        [2.0, 0.0, 3.0, 0.0, 0.0, 4.0]
    """
    a, _, _, b, c, _, d, e, f = matrix.flatten(-2).split(1, -1)
    l11 = a.sqrt()
    l21, l31 = b / l11, d / l11
    l22 = torch.maximum(c - l21 * l21, ROUNDING * c).sqrt()
    l32 = (e - l31 * l21) / l22
    l33 = torch.maximum(f - l31 * l31 - l32 * l32, ROUNDING * f).sqrt()
    return l11, l21, l22, l31, l32, l33


def invert(matrix: Tensor) -> Tensor:
    """The inverses of symmetric positive definite matrices (..., 3, 3).

    Example:
        >>> invert(torch.diag(torch.tensor([4.0, 16.0, 1.0]))).diagonal().tolist()
        [0.25, 0.0625, 1.0]
    """
    l11, l21, l22, l31, l32, l33 = factor(matrix)
    # The elements of the inverse of the factor.
    m11, m22, m33 = 1 / l11, 1 / l22, 1 / l33
    m21 = -l21 * m11 * m22
    m32 = -l32 * m22 * m33
    m31 = -(l31 * m11 + l32 * m21) * m33
    xx, xy, xh = m11 * m11 + m21 * m21 + m31 * m31, m21 * m22 + m31 * m32, m31 * m33
    yy, yh, hh = m22 * m22 + m32 * m32, m32 * m33, m33 * m33
    return torch.cat([xx, xy, xh, xy, yy, yh, xh, yh, hh], -1).unflatten(-1, (3, 3))


def log_determinant(matrix: Tensor) -> Tensor:
    """The logarithms (...) of the determinants of symmetric positive definite matrices (..., 3, 3).

    Example:
        >>> round(float(log_determinant(2 * torch.eye(3))), 4)  # log 8
        2.0794
    """
    l11, _, l22, _, _, l33 = factor(matrix)
    return 2 * (l11.log() + l22.log() + l33.log()).squeeze(-1)


class ResidualNetwork(TrainedModel):
    """Base class of the networks that measure residual motions: their training, use and calibration.

    A subclass defines :meth:`measure` and ``loss``.

    Attributes:
        units: (3,) units of x, y (metres) and heading (radians) in which the head solves and in which the
            loss compares, so that errors of the three are of similar size.
        warping: how the network is used in a stream of scans.
        drawn: the sensor with the bins into which scans are rendered.
        typical_change: (3,) root mean square of the difference between consecutive training steps, in metres,
            metres and radians.
        scale: (3,) factors of the standard deviations, fitted on validation drives; 1 before calibration.
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

    def set_units(self, steps: Sequence[FloatArray]) -> None:
        """Also computes ``typical_change`` from the steps (N, 3) of each training drive."""
        super().set_units(steps)
        changes = np.concatenate([np.diff(drive, axis=0) for drive in steps])
        self.typical_change.copy_(torch.from_numpy(np.sqrt(np.square(changes).mean(0))))

    def take_weights(self, model: TrainedModel) -> None:
        """Also keeps ``typical_change`` of the new training drives."""
        typical_change = self.typical_change.clone()
        super().take_weights(model)
        self.typical_change.copy_(typical_change)

    def describe(self) -> Description:
        """The description with ``warping`` and ``typical_change``."""
        x, y, heading = self.typical_change.double().tolist()
        return replace(super().describe(), warping=self.warping, typical_change=(x, y, heading))

    @abstractmethod
    def measure(self, pairs: Tensor, state: State = ()) -> tuple[Tensor, Tensor, State]:
        """Measures the residual motions of pairs of rendered scans.

        Args:
            pairs: (B, T, 2, rendered bins) metres; the earlier scan, seen from the guess, is the first.
            state: as returned for the pairs before; empty at the beginning.

        Returns:
            The motions (B, T, 3) and their information matrices (B, T, 3, 3), in ``units``, and the state
            after the last pair.
        """

    def forward(self, pairs: Tensor, state: State = ()) -> tuple[Tensor, Tensor, State]:
        """Measures the residual motions in metres and radians, with calibrated covariances.

        Args:
            pairs: (B, T, 2, rendered bins) metres; the earlier scan, seen from the guess, is the first.
            state: as returned for the pairs before; empty at the beginning.

        Returns:
            The true pose of each later scan in the frame of its guessed pose (B, T, 3); the covariances
            (B, T, 3, 3); and the state after the last pair.
        """
        motion, matrix, state = self.measure(pairs, state)
        units = self.units * self.scale
        return motion * self.units, invert(matrix) * units * units.unsqueeze(-1), state

    def estimate_scans(self, scans: Tensor) -> Steps:
        """The steps of encoded scans (N, bins), as in a stream, in full precision."""
        values = scans.cpu().numpy()
        with torch.autocast(scans.device.type, enabled=False):
            return estimate_encoded(self.stepper(), values)

    def calibrate(self, drives: Sequence[Drive]) -> None:
        """Also fits ``scale``, so that 68.27 % of the errors lie within one standard deviation.

        The scale also changes how much of a measurement the filter believes, so it is fitted again with the
        steps that it leads to. Where that does not converge, because the drives move otherwise than
        ``typical_change`` says, the best scale so far is kept.

        ``period`` remains nan, because residual motions can be measured at any rate of scans.
        """
        super().calibrate(drives)
        self.period.fill_(torch.nan)
        self.scale.fill_(1.0)
        best, smallest = self.scale.clone(), math.inf
        for _ in range(FITS):
            factor = self._find_correction(drives)
            size = float(np.abs(np.log(factor)).max())
            if size > CONVERGING * smallest:
                break
            best, smallest = self.scale.clone(), size
            if size < FITTED:
                break
            self.scale.mul_(torch.from_numpy(factor).float())
        self.scale.copy_(best)

    def _find_correction(self, drives: Sequence[Drive]) -> FloatArray:
        """Factors (3,) by which ``scale`` is too small for the errors of the present steps; 1 if unknown.

        Steps to scans without returns are not counted, because they are predicted, not measured.
        """
        ratios = []
        for drive in drives:
            steps = self.estimate(drive)
            deviations = np.sqrt(np.diagonal(steps.covariances, axis1=1, axis2=2))
            with np.errstate(invalid="ignore"):
                errors = np.abs(steps.values - drive.steps) / deviations
            ratios.append(errors[np.isfinite(errors).all(1) & drive.scans[1:].any(1)])
        counted = np.concatenate(ratios)
        if not len(counted):
            return np.ones(3)
        return np.maximum(np.quantile(counted, WITHIN_DEVIATION, axis=0), 1e-3)

    def compare_residuals(self, motion: Tensor, matrix: Tensor, truth: Tensor) -> dict[str, Tensor]:
        """The loss of estimated residual motions.

        Each error is divided by the size of the true residual motion, so that small motions are learned as
        accurately as large ones in relation to their size. The option ``floor`` (in ``units``), which is
        added to the size, limits this for very small motions.

        Args:
            motion: (N, 3) estimates, in ``units``.
            matrix: (N, 3, 3) their information matrices, in ``units``.
            truth: (N, 3) true residual motions in metres and radians.

        Returns:
            The scalars ``loss``, ``loss_relative`` and ``loss_likelihood``; and ``diverged`` (N,), True for
            estimates that are not finite.
        """
        truth = truth / self.units
        error = motion - truth
        relative = error.norm(dim=-1) / (truth.norm(dim=-1) + self.options["floor"])
        # Written without a matrix product, because autocast would round that to bf16.
        squares = (error.unsqueeze(-1) * matrix * error.unsqueeze(-2)).sum((-1, -2))
        likelihood = (squares - log_determinant(matrix)) / 2
        return {
            "loss": relative.mean() + LIKELIHOOD_WEIGHT * likelihood.mean(),
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
        """Renders pairs of scans as input of the network, and mirrors half of the windows.

        Windows are only mirrored if the laser faces forward or backward, because other lasers would cover
        another sector in the mirror image.

        Args:
            earlier, later: (..., bins) metres.
            guesses: (..., 3) guessed poses of the later scans in the frames of the earlier ones.
            residuals: (..., 3) true poses of the later scans in the frames of the guesses; those of mirrored
                windows are changed in place.
            rng: selects the windows, of the first dimension, that are mirrored.
            device: device of the returned tensors.

        Returns:
            Rendered pairs (..., 2, rendered bins) and residuals (..., 3).
        """
        flat, threads = (-1, self.sensor.bins), torch.get_num_threads()
        viewpoints, unmoved = guesses.reshape(-1, 3), np.zeros((residuals.size // 3, 3))
        before = render_many(earlier.reshape(flat), self.sensor, viewpoints, self.drawn, threads)
        now = render_many(later.reshape(flat), self.sensor, unmoved, self.drawn, threads)
        pairs = np.stack([before, now], 1).reshape(*residuals.shape[:-1], 2, self.drawn.bins)
        if self.sensor.facing_deg % 180 == 0:
            mirrored = rng.random(len(pairs)) < 0.5
            pairs[mirrored] = pairs[mirrored, ..., ::-1]
            residuals[mirrored, ..., 1:] *= -1
        return torch.from_numpy(pairs).to(device), torch.from_numpy(residuals).float().to(device)

    def draw_residual(self, step: FloatArray, rng: np.random.Generator) -> FloatArray:
        """A random residual motion (3,) in metres and radians, for a guess of a true step (3,).

        The whole step is returned in some cases: then the guess assumes no motion.
        """
        x, y, heading = np.abs(step)
        if rng.random() < REST_FRACTION and max(x, y) < LARGEST_REST_DISTANCE and heading < LARGEST_REST_TURN:
            return step
        options = ResidualOptions(**self.options["residual"])
        deviations = np.array([options.x, options.y, math.radians(options.heading_deg)])
        # A scale for each part: with a common one, the network infers one part from the others, for instance
        # along a corridor that the guess is right since its heading is (docs/warp.md).
        scales = 10 ** rng.uniform(options.smallest, options.largest, 3)
        drawn: FloatArray = deviations * rng.standard_normal(3) * scales
        return drawn


def find_scans_and_poses(batch: Batch) -> tuple[DepthVector, FloatArray]:
    """The scans (B, T + 1, bins) of a batch of windows, and their poses (B, T + 1, 3) relative to the first.

    Raises:
        InputError: the second scan of a pair differs from the first scan of the next pair.
    """
    if not torch.equal(batch["pairs"][:, 1:, 0], batch["pairs"][:, :-1, 1]):
        raise InputError(
            "data.augment.max_turn_deg: it turns only the second scan of each pair, which does not work with "
            "networks that measure residual motions; remove this option"
        )
    scans = torch.cat([batch["pairs"][:, :, 0], batch["pairs"][:, -1:, 1]], 1).cpu().numpy()
    steps = batch["steps"].double().cpu().numpy()
    return scans, np.stack([poses_to_planar(compose(each)) for each in steps])


def seeded_generator() -> np.random.Generator:
    """A random generator seeded by torch's, so that a resumed training continues with the same numbers."""
    return np.random.default_rng(int(torch.randint(2**62, ())))


class CNNWarp(ResidualNetwork):
    """The paper's encoder for a pair of rendered scans, and local constraints; it has no state."""

    name = "cnn_warp"
    Options = WarpOptions

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self.encoder = Encoder(self.drawn, options["kernel_size"], options["pooling"], CHANNELS)
        self.head = LocalConstraints(
            self.encoder.channels, self.encoder.places, self.drawn, options["radians_a_metre"]
        )

    def measure(self, pairs: Tensor, state: State = ()) -> tuple[Tensor, Tensor, State]:
        """Motions (B, T, 3) and their information matrices (B, T, 3, 3), in ``units``, and the state."""
        flat = pairs.flatten(0, -3)
        features = self.encoder.convolve(compare(flat, self.drawn))
        motion, matrix = self.head(features, flat)
        return motion.unflatten(0, pairs.shape[:-2]), matrix.unflatten(0, pairs.shape[:-2]), state

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """The loss of one random pair of scans of each window, see :meth:`compare_residuals`."""
        pairs, residuals = self.draw(batch)
        motion, matrix, _ = self.measure(pairs.unsqueeze(1))
        return self.compare_residuals(motion[:, 0], matrix[:, 0], residuals)

    def draw(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Selects two scans of each window, in any order, and draws a guess of their motion.

        Returns:
            Rendered pairs (B, 2, rendered bins) and residual motions (B, 3) in metres and radians.
        """
        scans, poses = find_scans_and_poses(batch)
        rng = seeded_generator()
        chosen = np.array([rng.choice(scans.shape[1], 2, replace=False) for _ in scans])
        earlier, later = (scans[np.arange(len(scans)), which] for which in chosen.T)
        guesses, residuals = np.empty((2, len(scans), 3))
        for n, (first, second) in enumerate(chosen):
            step = relative_step(poses[n, first], poses[n, second])
            residuals[n] = self.draw_residual(step, rng)
            guesses[n] = advance(step, relative_step(residuals[n], np.zeros(3)))
        return self.draw_scans(earlier, later, guesses, residuals, rng, batch["pairs"].device)
