"""The four variants of the paper as LightningModules."""

from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import lightning as L
import numpy as np
import torch
from torch import Tensor

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift_metric import DriftMetric
from rcnn_odom.evaluation.scores import camera_trajectory, frame_errors
from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.losses import classification_loss, regression_loss
from rcnn_odom.models.networks import CNN, RCNN, RotationClasses
from rcnn_odom.models.uncertainty import Uncertainty
from rcnn_odom.training.datamodule import Batch, OdometryDataModule
from rcnn_odom.training.machine import keep_freed_memory
from rcnn_odom.training.settings import Settings

EVALUATION_CHUNK = 64
"""Pairs that go through the convolutions together when a whole drive is estimated."""


class DriveEstimate(NamedTuple):
    """A network's estimate of one whole drive.

    Attributes:
        motions: (N-1, 2) metres and radians.
        deviations: their standard deviations, (N-1, 2); nan while the uncertainty is not fitted.
        features: (N-1, K) of :class:`rcnn_odom.models.uncertainty.Uncertainty`.
    """

    motions: FloatArray
    deviations: FloatArray
    features: FloatArray


class OdometryModule(L.LightningModule):
    """What the variants share: training step, drives estimated in order, optimiser, logging.

    Args:
        model: the options of ``conf/model``, plain.
        sensor: of :class:`rcnn_odom.models.encoding.Sensor`, plain.
        scoring: ``lengths`` (metres) and ``apply`` for the validation drift, plain.
    """

    variant: ClassVar[str]
    recurrent: ClassVar[bool]
    classifies: ClassVar[bool]
    network: CNN | RCNN

    def __init__(self, model: Settings, sensor: Settings, scoring: Settings) -> None:
        super().__init__()
        self.save_hyperparameters(
            {"variant": self.variant, "model": model, "sensor": sensor, "scoring": scoring}
        )
        self.model, self.scoring = model, scoring
        self.sensor = Sensor(**sensor)
        self.classes = RotationClasses(**model["rotation_classes"])
        self.network = self._build()
        self.uncertainty = Uncertainty(self.recurrent)
        self.estimates: dict[int, DriveEstimate] = {}
        self.estimates_file: Path | None = None
        """Where a test in other processes leaves its estimates."""
        self.fingerprint = ""
        """Of the training, for its checkpoints: see :func:`rcnn_odom.training.run_state.fingerprint`."""

    def _build(self) -> CNN | RCNN:
        model = self.model
        cnn_classes = self.classes if self.classifies or self.recurrent else None
        angle, dropout = model["angle"], model["dropout"]
        cnn = CNN(
            self.sensor.bins,
            self.sensor.max_range,
            cnn_classes,
            model["kernel_size"],
            model["pooling"],
            angle,
            0.0 if self.recurrent else dropout,
        )
        if not self.recurrent:
            return cnn
        cnn.requires_grad_(not model["freeze"])
        head_classes = self.classes if self.classifies else None
        sizes = model["hidden_size"], model["layers"]
        return RCNN(cnn, head_classes, *sizes, angle, dropout, model["projection"])

    def set_motion_statistics(self, mean: FloatArray, deviation: FloatArray) -> None:
        """Mean and deviation (2,), (2,) of the training motions, the heads' units."""
        heads = [self.network.head] + ([self.network.cnn.head] if isinstance(self.network, RCNN) else [])
        for head in heads:
            head.mean.copy_(torch.from_numpy(mean))
            head.deviation.copy_(torch.from_numpy(deviation))

    def setup(self, stage: str) -> None:
        """Lightning's hook, in every process that trains or tests."""
        keep_freed_memory()

    def teardown(self, stage: str) -> None:
        """Lightning's hook at the end, in every process: lets go of the others.

        A process that ends while it still holds the connection sometimes aborts.
        """
        if self.trainer.world_size > 1 and torch.distributed.is_initialized():
            torch.distributed.barrier()
            torch.distributed.destroy_process_group()

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Makes dropout a function of the step, so that a training that goes on draws what it would have."""
        drawn_from = [self._data.seed, self.global_step, self.global_rank]
        torch.manual_seed(int(np.random.SeedSequence(drawn_from).generate_state(1)[0]))

    def training_step(self, batch: Batch, batch_idx: int) -> dict[str, Tensor]:
        """The loss of one batch of windows and its parts, scalars.

        Raises:
            InputError: the loss is nan or inf.
        """
        truth = batch["motions"]
        estimate, _ = self.network(batch["pairs"])
        beta, per_sample = self.model["beta"], self.model["per_sample_norm"]
        outside = {}
        if estimate.scores is None:
            loss = regression_loss(estimate.motion, truth, beta, per_sample)
        else:
            classes = self.classes.index(truth[..., 1])
            loss = classification_loss(estimate.motion, estimate.scores, truth, classes, beta, per_sample)
            share = self.classes.outside(truth[..., 1]) / truth[..., 1].numel()
            outside = {"headings_outside_classes": share}
        self._trained_on = batch["frames"]
        if not loss.total.isfinite():
            finite = estimate.motion.isfinite().all(-1).all(-1)
            # One bad window spoils the mean of all: the estimates tell which it is.
            self._trained_on = batch["frames"] if finite.all() else batch["frames"][~finite]
            raise self._diverged("the loss is nan or inf", self.global_step + 1)
        parts = {"loss_distance": loss.distance, "loss_rotation": loss.rotation}
        return {"loss": loss.total, **parts, **outside}

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clips the gradient's norm.

        Lightning refuses to with a fused optimiser under mixed precision, because of the loss scaling of
        fp16, which bf16 does without.

        Raises:
            InputError: the gradient is nan or inf; the weights are still good.
        """
        norm = torch.nn.utils.clip_grad_norm_(self.parameters(), gradient_clip_val or float("inf"))
        if not norm.isfinite():
            raise self._diverged("the gradient is nan or inf", self.global_step + 1)

    def check_weights(self) -> None:
        """Looks for nan and inf before the weights are kept.

        Raises:
            InputError: there are some.
        """
        if not all(parameter.isfinite().all() for parameter in self.parameters()):
            raise self._diverged("a weight is nan or inf", self.global_step)

    def _diverged(self, what: str, step: int) -> InputError:
        windows = self._data.windows
        frames = windows.describe(self._trained_on.tolist()) if windows else "unknown"
        return InputError(
            f"training diverged in epoch {self.current_epoch + 1}, step {step}: {what}, after "
            f"frames {frames}; look at these, or set model.learning_rate lower"
        )

    @property
    def _data(self) -> OdometryDataModule:
        return self.trainer.datamodule  # type: ignore[attr-defined,no-any-return]

    @torch.no_grad()
    def estimate(self, scans: Tensor) -> DriveEstimate:
        """The motions of one whole drive (N, bins) in metres, the LSTM state carried throughout.

        In full precision whatever the training's, so that a checkpoint gives the same numbers everywhere.
        """
        state, motions, features = None, [], []
        with torch.autocast(scans.device.type, enabled=False):
            for start in range(0, len(scans) - 1, EVALUATION_CHUNK):
                block = scans[start : start + EVALUATION_CHUNK + 1]
                pairs = torch.stack([block[:-1], block[1:]], dim=1)
                estimate, state = self.network(pairs[None], state)
                motions.append(estimate.motion[0].double().cpu().numpy())
                difficulty = self.uncertainty.features(estimate, self.network.head)
                features.append(difficulty[0].double().cpu().numpy())
        weights = self.uncertainty.weights.double().cpu().numpy()
        difficulties = np.concatenate(features)
        return DriveEstimate(np.concatenate(motions), difficulties @ weights.T, difficulties)

    def on_validation_epoch_start(self) -> None:
        """Forgets the estimates of the epoch before."""
        self.estimates = {}

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Keeps the estimate of one whole sequence.

        Raises:
            InputError: training has diverged.
        """
        estimate = self.estimate(batch["scans"])
        if not np.isfinite(estimate.motions).all():
            raise self._diverged("validation is estimated as nan or inf", self.global_step)
        self.estimates[batch["number"]] = estimate

    def on_validation_epoch_end(self) -> None:
        """Logs the drift of each validation sequence and their mean, and the mean errors of a frame.

        Raises:
            InputError: a weight is nan or inf, behind a ReLU that hides it; it must not become the best.
        """
        self.check_weights()
        self._gather_estimates()
        sequences = self._data.sequences["val"]
        names = [sequence.name for sequence in sequences]
        drift = DriftMetric(names, lengths=self.scoring["lengths"], planar=True)
        errors, frames = [], []
        for number, estimate in sorted(self.estimates.items()):
            sequence = sequences[number]
            poses = camera_trajectory(sequence, estimate.motions, self.scoring["apply"])
            drift.update(sequence.camera_poses, poses, sequence.name)
            errors.append(frame_errors(estimate.motions, sequence.motions))
            frames.append(len(estimate.motions))
        for name, value in drift.compute().items():
            self.log(f"val/{name}", value)
        for name in ("distance_mae_m", "heading_mae_deg"):
            self.log(f"val/{name}", float(np.average([error[name] for error in errors], weights=frames)))

    def on_test_epoch_start(self) -> None:
        """Forgets the estimates of an earlier test."""
        self.estimates = {}

    def test_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Keeps the estimate of one whole sequence; ``rcnn_odom.evaluation.scores`` scores it."""
        self.estimates[batch["number"]] = self.estimate(batch["scans"])

    def on_test_epoch_end(self) -> None:
        """Every process gets the estimates of all, and one leaves them in ``estimates_file``."""
        self._gather_estimates()
        if self.estimates_file and self.global_rank == 0:
            arrays = {
                f"{number}/{name}": array
                for number, drive in self.estimates.items()
                for name, array in drive._asdict().items()
            }
            np.savez(self.estimates_file, **arrays)

    def load_estimates(self) -> None:
        """Takes what a test in other processes has left in ``estimates_file``."""
        assert self.estimates_file is not None
        with np.load(self.estimates_file) as arrays:
            numbers = {name.split("/")[0] for name in arrays}
            self.estimates = {
                int(number): DriveEstimate(*(arrays[f"{number}/{name}"] for name in DriveEstimate._fields))
                for number in numbers
            }

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Signs the checkpoint."""
        checkpoint["fingerprint"] = self.fingerprint

    def _gather_estimates(self) -> None:
        """Shares estimates among processes; a sequence that two of them have counts once."""
        if self.trainer.world_size > 1:
            shares: list[Any] = [None] * self.trainer.world_size
            torch.distributed.all_gather_object(shares, self.estimates)
            self.estimates = {number: drive for share in shares for number, drive in share.items()}

    def configure_optimizers(self) -> Any:
        """Adam with a one-cycle rate over the whole training."""
        rate = self.model["learning_rate"]
        optimizer = torch.optim.Adam([p for p in self.parameters() if p.requires_grad], lr=rate, fused=True)
        # Not the trainer's own count, which makes the loader before a checkpoint can tell it where to go on.
        assert self.trainer.max_epochs is not None
        steps = self.trainer.max_epochs * self._data.batches_per_epoch
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class CNNRegression(OdometryModule):
    """Both outputs by eq. 3 from one pair of scans."""

    variant, recurrent, classifies = "cnn_reg", False, False


class CNNClassification(OdometryModule):
    """Rotation by eq. 4 from one pair of scans: the first stage of both recurrent variants."""

    variant, recurrent, classifies = "cnn_cls", False, True


class RecurrentModule(OdometryModule):
    """A first stage, then an LSTM."""

    recurrent = True

    def load_first_stage(self, cnn: CNNClassification) -> None:
        """Takes the weights of a trained CNN."""
        assert isinstance(self.network, RCNN)
        self.network.cnn.load_state_dict(cnn.network.state_dict())


class RCNNRegression(RecurrentModule):
    """Eq. 3 after the LSTM: the paper's best."""

    variant, classifies = "rcnn_reg", False


class RCNNClassification(RecurrentModule):
    """Eq. 4 after the LSTM."""

    variant, classifies = "rcnn_cls", True


VARIANTS: dict[str, type[OdometryModule]] = {
    module.variant: module
    for module in (CNNRegression, CNNClassification, RCNNRegression, RCNNClassification)
}
