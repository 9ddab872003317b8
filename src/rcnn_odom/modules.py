"""The four variants of the paper as LightningModules."""

from typing import Any, ClassVar, NamedTuple

import lightning as L
import numpy as np
import torch
from torch import Tensor
from torchmetrics import MeanMetric

from rcnn_odom.cache import EncodedSequence
from rcnn_odom.datamodule import Batch
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation import camera_trajectory, frame_errors
from rcnn_odom.losses import Loss, classification_loss, regression_loss
from rcnn_odom.metrics.module import DriftMetric
from rcnn_odom.motion import FloatArray
from rcnn_odom.networks import CNN, RCNN, RotationClasses
from rcnn_odom.scan import Sensor
from rcnn_odom.settings import Settings
from rcnn_odom.uncertainty import Uncertainty

EVALUATION_CHUNK = 64
"""Pairs that go through the convolutions together when a whole drive is estimated."""


class DriveEstimate(NamedTuple):
    """A network's estimate of one whole drive.

    Attributes:
        motions: (N-1, 2) metres and radians.
        deviations: their standard deviations, (N-1, 2); nan while the uncertainty is not fitted.
        features: (N-1, K) of :class:`rcnn_odom.uncertainty.Uncertainty`.
    """

    motions: FloatArray
    deviations: FloatArray
    features: FloatArray


class OdometryModule(L.LightningModule):
    """What the variants share: training step, drives estimated in order, optimiser, logging.

    Args:
        model: the options of ``conf/model``, plain.
        sensor: of :class:`rcnn_odom.scan.Sensor`, plain.
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
        self.outside = MeanMetric()

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

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of one batch of windows, and its parts into the log."""
        truth = batch["motions"]
        estimate, _ = self.network(batch["pairs"])
        beta, per_sample = self.model["beta"], self.model["per_sample_norm"]
        if estimate.scores is None:
            loss = regression_loss(estimate.motion, truth, beta, per_sample)
        else:
            classes = self.classes.index(truth[..., 1])
            loss = classification_loss(estimate.motion, estimate.scores, truth, classes, beta, per_sample)
            self.outside(self.classes.outside(truth[..., 1]) / truth[..., 1].numel())
            self.log("train/headings_outside_classes", self.outside, on_step=False, on_epoch=True)
        self._log_losses(loss, len(truth))
        return loss.total

    def _log_losses(self, loss: Loss, batch_size: int) -> None:
        parts = {"train/loss": loss.total, "train/loss_distance": loss.distance}
        parts["train/loss_rotation"] = loss.rotation
        self.log_dict(parts, on_step=True, on_epoch=True, batch_size=batch_size)
        self.log(
            "train/learning_rate", self.trainer.optimizers[0].param_groups[0]["lr"], batch_size=batch_size
        )

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clips the gradient's norm.

        Lightning refuses to with a fused optimiser under mixed precision, because of the loss scaling of
        fp16, which bf16 does without.
        """
        if gradient_clip_val is not None:
            torch.nn.utils.clip_grad_norm_(self.parameters(), gradient_clip_val)

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

    def _validation(self) -> list[EncodedSequence]:
        return self.trainer.datamodule.sequences["val"]  # type: ignore[attr-defined]

    def on_validation_epoch_start(self) -> None:
        """A metric for this epoch alone."""
        names = [sequence.name for sequence in self._validation()]
        self.drift = DriftMetric(names, lengths=self.scoring["lengths"], planar=True).to(self.device)

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Scores one whole sequence.

        Raises:
            InputError: training has diverged.
        """
        sequence = self._validation()[batch["number"]]
        motions = self.estimate(batch["scans"]).motions
        if not np.isfinite(motions).all():
            raise InputError(
                f"training diverged in epoch {self.current_epoch + 1}: {sequence.name} is estimated as nan "
                "or inf; set model.learning_rate lower"
            )
        estimate = camera_trajectory(sequence, motions, self.scoring["apply"])
        self.drift.update(sequence.camera_poses, estimate, sequence.name)
        errors = frame_errors(motions, sequence.motions)
        frames = len(motions)
        self.log("val/distance_mae_m", errors["distance_mae_m"], batch_size=frames)
        self.log("val/heading_mae_deg", errors["heading_mae_deg"], batch_size=frames)

    def on_validation_epoch_end(self) -> None:
        """Logs the drift of each validation sequence and their mean."""
        for name, value in self.drift.compute().items():
            self.log(f"val/{name}", value)

    def on_test_epoch_start(self) -> None:
        """Forgets the estimates of an earlier test."""
        self.estimates = {}

    def test_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Keeps the estimate of one whole sequence; ``rcnn_odom.evaluation`` scores it."""
        self.estimates[batch["number"]] = self.estimate(batch["scans"])

    def configure_optimizers(self) -> Any:
        """Adam with a one-cycle rate over the whole training."""
        model = self.model
        optimizer = torch.optim.Adam(
            [p for p in self.parameters() if p.requires_grad], lr=model["learning_rate"], fused=True
        )
        steps = int(self.trainer.estimated_stepping_batches)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, model["learning_rate"], total_steps=steps)
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
