"""Models as LightningModules: one class trains any model, the four of the paper have names of their own."""

import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import lightning as L
import numpy as np
import torch
from torch import Tensor

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift_metric import DriftMetric
from rcnn_odom.evaluation.metrics import DRIFT, all_metrics
from rcnn_odom.evaluation.run_folder import Settings
from rcnn_odom.geometry import FloatArray, Steps, change_frame
from rcnn_odom.models.contract import find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.trained import Batch, TrainedModel
from rcnn_odom.training.cluster import has_joined
from rcnn_odom.training.datamodule import OdometryDataModule
from rcnn_odom.training.machine import keep_freed_memory


class OdometryModule(L.LightningModule):
    """Trains any model: training step, drives estimated in order, optimiser, logging.

    Args:
        variant: name of a model that trains.
        options: those of ``conf/model``, plain.
        sensor: of :class:`rcnn_odom.models.encoding.Sensor`, plain.
        lengths: in metres, of the segments of the validation drift.

    Attributes:
        model: the model.
        mean_step: (3,) of the training drives, metres and radians, for the baseline ``mean_motion``.
        estimates: the steps of the drives that were validated or tested last, by the drives' names.
        estimates_file: where a test in other processes leaves its estimates.
        fingerprint, code: of the training, for its checkpoints: see
            :class:`rcnn_odom.training.run_state.Fingerprints`.
    """

    variant: str
    mean_step: Tensor

    def __init__(self, variant: str, options: Settings, sensor: Settings, lengths: list[float]) -> None:
        super().__init__()
        self.save_hyperparameters(
            {"variant": variant, "model": options, "sensor": sensor, "lengths": lengths}
        )
        self.variant, self.lengths = variant, lengths
        self.model = cast(TrainedModel, find_model(variant)(options, Sensor(**sensor)))
        self.register_buffer("mean_step", torch.full((3,), torch.nan))
        self.estimates: dict[str, Steps] = {}
        self.estimates_file: Path | None = None
        self.fingerprint = self.code = ""

    def set_units(self, steps: FloatArray) -> None:
        """Told the training drives' steps (N, 3) before training, in metres and radians."""
        self.mean_step.copy_(torch.from_numpy(steps.mean(0)))
        self.model.set_units(steps)

    def setup(self, stage: str) -> None:
        """Lightning's hook, in every process that trains or tests."""
        keep_freed_memory()

    def teardown(self, stage: str) -> None:
        """Lightning's hook at the end, in every process: lets go of the others.

        A process that ends while it still holds the connection sometimes aborts. Processes that a cluster has
        started do not end yet.
        """
        if self.trainer.world_size > 1 and not has_joined() and torch.distributed.is_initialized():
            torch.distributed.barrier()
            torch.distributed.destroy_process_group()

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Makes dropout a function of the step, so that a training that goes on draws what it would have."""
        drawn_from = [self._data.seed, self.global_step, self.global_rank]
        torch.manual_seed(int(np.random.SeedSequence(drawn_from).generate_state(1)[0]))

    def training_step(self, batch: Batch, batch_idx: int) -> dict[str, Tensor]:
        """The loss of one batch of windows and what the model logs beside it, scalars.

        Raises:
            InputError: the loss is nan or inf.
        """
        outputs = self.model.loss(batch)
        to_blame = outputs.pop("diverged", None)
        self._trained_on = batch["frames"]
        if not outputs["loss"].isfinite():
            if to_blame is not None and to_blame.any():
                self._trained_on = batch["frames"][to_blame]
            raise self._diverged("the loss is nan or inf", self.global_step + 1)
        return outputs

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

    def on_validation_epoch_start(self) -> None:
        """Forgets the estimates of the epoch or the test before."""
        self.estimates = {}

    on_test_epoch_start = on_validation_epoch_start

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Keeps the estimate of one whole drive.

        Raises:
            InputError: training has diverged.
        """
        steps = self.model.estimate_scans(batch["scans"])
        if not np.isfinite(steps.values).all():
            raise self._diverged("validation is estimated as nan or inf", self.global_step)
        self.estimates[batch["name"]] = steps

    def on_validation_epoch_end(self) -> None:
        """Logs the drift of each validation drive and their mean, and the other metrics of a training.

        Raises:
            InputError: a weight is nan or inf, behind a ReLU that hides it; it must not become the best.
        """
        self.check_weights()
        self._gather_estimates()
        drives = [drive for drive in self._data.drives["val"] if drive.name in self.estimates]
        drift = DriftMetric([drive.name for drive in drives], lengths=self.lengths, planar=True)
        for drive in drives:
            poses = change_frame(self.estimates[drive.name].poses(), drive.camera_from_laser)
            drift.update(drive.camera_poses, poses, drive.name)
        values: dict[str, Any] = dict(drift.compute())
        frames = [len(self.estimates[drive.name]) for drive in drives]
        for metric in all_metrics().values():
            if metric.in_training and metric.name != DRIFT.name:
                each = [metric.compute(drive, self.estimates[drive.name], self.lengths) for drive in drives]
                values[metric.name] = metric.over(each, frames)
        self.log_dict({f"val/{name}": value for name, value in values.items() if value is not None})

    def test_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Keeps the estimate of one whole drive; ``rcnn_odom.evaluation.scores`` scores it."""
        self.estimates[batch["name"]] = self.model.estimate_scans(batch["scans"])

    def on_test_epoch_end(self) -> None:
        """Every process gets the estimates of all, and one leaves them in ``estimates_file``."""
        self._gather_estimates()
        if self.estimates_file and self.global_rank == 0:
            self.estimates_file.write_bytes(pickle.dumps(self.estimates))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Signs the checkpoint."""
        checkpoint |= {"fingerprint": self.fingerprint, "code": self.code}

    def _gather_estimates(self) -> None:
        """Shares estimates among processes; a drive that two of them have counts once."""
        if self.trainer.world_size > 1:
            shares: list[Any] = [None] * self.trainer.world_size
            torch.distributed.all_gather_object(shares, self.estimates)
            self.estimates = {name: steps for share in shares for name, steps in share.items()}

    def configure_optimizers(self) -> Any:
        """Adam with a one-cycle rate over the whole training.

        The one-cycle schedule also lets Adam's beta1 fall from 0.95 to 0.85 while the rate rises, and rise
        again while it falls: ``cycle_momentum``, on by default in PyTorch.
        """
        rate = self.model.options["learning_rate"]
        optimizer = torch.optim.Adam([p for p in self.parameters() if p.requires_grad], lr=rate, fused=True)
        # Not the trainer's own count, which makes the loader before a checkpoint can tell it where to go on.
        assert self.trainer.max_epochs is not None
        steps = self.trainer.max_epochs * steps_per_epoch(self.trainer.limit_train_batches, self._data)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def steps_per_epoch(limit: float | None, data: OdometryDataModule) -> int:
    """Steps of an epoch that ``trainer.limit_train_batches`` may cut; Lightning's 1.0 cuts nothing."""
    return min(limit, data.batches_per_epoch) if isinstance(limit, int) else data.batches_per_epoch


class PaperModule(OdometryModule):
    """A module that knows which model it trains."""

    def __init__(self, options: Settings, sensor: Settings, lengths: list[float]) -> None:
        super().__init__(self.variant, options, sensor, lengths)


class CNNRegression(PaperModule):
    """Both outputs by eq. 3 from one pair of scans."""

    variant = "cnn_reg"


class CNNClassification(PaperModule):
    """Rotation by eq. 4 from one pair of scans: the first stage of both recurrent variants."""

    variant = "cnn_cls"


class RCNNRegression(PaperModule):
    """Eq. 3 after the LSTM: the paper's best."""

    variant = "rcnn_reg"


class RCNNClassification(PaperModule):
    """Eq. 4 after the LSTM."""

    variant = "rcnn_cls"


def module_for(variant: str) -> Callable[[Settings, Settings, list[float]], OdometryModule]:
    """What makes the module of a model out of options, sensor and lengths, as :class:`OdometryModule`."""
    named = {module.variant: module for module in PaperModule.__subclasses__()}
    return named.get(variant) or partial(OdometryModule, variant)
