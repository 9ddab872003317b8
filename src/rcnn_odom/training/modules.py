"""LightningModules: one class trains any model; the four networks of the paper have subclasses."""

import pickle
from collections.abc import Callable, Sequence
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
    """Trains, validates and tests any model.

    Args:
        variant: name of a model that can be trained.
        options: options of the model as plain values, see ``conf/model``.
        sensor: fields of :class:`rcnn_odom.models.encoding.Sensor` as plain values.
        lengths: lengths in metres of the segments of the validation drift.

    Attributes:
        model: the model.
        mean_step: (3,) mean step of the training drives, metres and radians, for the baseline
            ``mean_motion``.
        estimates: estimated steps of the last validation or test, by the names of the drives.
        estimates_file: file in which a test in other processes saves its estimates; None: no file.
        fingerprint, code: fingerprints of the training, which are saved in its checkpoints; see
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

    def set_units(self, steps: Sequence[FloatArray]) -> None:
        """Sets the units of the network from the steps (N, 3) of each training drive, metres and radians."""
        self.mean_step.copy_(torch.from_numpy(np.concatenate(steps).mean(0)))
        self.model.set_units(steps)

    def setup(self, stage: str) -> None:
        """Lightning's hook, in every process that trains or tests."""
        keep_freed_memory()

    def teardown(self, stage: str) -> None:
        """Lightning's hook at the end, in every process: closes the connection to the other processes.

        A process that ends with an open connection sometimes aborts. Processes that were started by torchrun
        or Slurm keep the connection, since they have more work to do.
        """
        if self.trainer.world_size > 1 and not has_joined() and torch.distributed.is_initialized():
            torch.distributed.barrier()
            torch.distributed.destroy_process_group()

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Seeds dropout by the step, so that a resumed training draws the same random numbers."""
        entropy = [self._datamodule.seed, self.global_step, self.global_rank]
        torch.manual_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))

    def training_step(self, batch: Batch, batch_idx: int) -> dict[str, Tensor]:
        """Computes the loss of a batch of windows, and the other scalars that the model logs.

        Returns:
            ``loss`` and the other scalars by name.

        Raises:
            InputError: the loss is nan or inf.
        """
        outputs = self.model.loss(batch)
        diverged = outputs.pop("diverged", None)
        self._last_frames = batch["frames"]
        if not outputs["loss"].isfinite():
            if diverged is not None and diverged.any():
                self._last_frames = batch["frames"][diverged]
            raise self._divergence_error("the loss is nan or inf", self.global_step + 1)
        return outputs

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clips the norm of the gradient.

        Lightning refuses to clip with a fused optimiser and mixed precision, because of the loss scaling of
        fp16. bf16 needs no loss scaling.

        Raises:
            InputError: the gradient is nan or inf. The weights have not been changed yet.
        """
        norm = torch.nn.utils.clip_grad_norm_(self.parameters(), gradient_clip_val or float("inf"))
        if not norm.isfinite():
            raise self._divergence_error("the gradient is nan or inf", self.global_step + 1)

    def check_weights(self) -> None:
        """Checks the weights before they are saved.

        Raises:
            InputError: a weight is nan or inf.
        """
        if not all(parameter.isfinite().all() for parameter in self.parameters()):
            raise self._divergence_error("a weight is nan or inf", self.global_step)

    def _divergence_error(self, what: str, step: int) -> InputError:
        """An error that names the frames of the last batch."""
        windows = self._datamodule.windows
        frames = windows.describe(self._last_frames.tolist()) if windows else "unknown"
        return InputError(
            f"training diverged in epoch {self.current_epoch + 1}, step {step}: {what}, after "
            f"frames {frames}; look at these, or set model.learning_rate lower"
        )

    @property
    def _datamodule(self) -> OdometryDataModule:
        return self.trainer.datamodule  # type: ignore[attr-defined,no-any-return]

    def on_validation_epoch_start(self) -> None:
        """Removes the estimates of the previous validation or test."""
        self.estimates = {}

    on_test_epoch_start = on_validation_epoch_start

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Estimates one whole drive.

        Raises:
            InputError: the estimate is nan or inf, since the training has diverged.
        """
        steps = self.model.estimate_scans(batch["scans"])
        if not np.isfinite(steps.values).all():
            raise self._divergence_error("a validation estimate is nan or inf", self.global_step)
        self.estimates[batch["name"]] = steps

    def on_validation_epoch_end(self) -> None:
        """Logs the drift of each validation drive, their mean, and the other validation metrics.

        Raises:
            InputError: a weight is nan or inf. A ReLU may hide that in the estimates, and such weights must
                not become the best ones.
        """
        self.check_weights()
        self._gather_estimates()
        drives = [drive for drive in self._datamodule.drives["val"] if drive.name in self.estimates]
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
        # TrainingLog writes them to TensorBoard under readable names.
        named = {f"val/{name}": value for name, value in values.items() if value is not None}
        self.log_dict(named, logger=False)

    def test_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Estimates one whole drive, for ``rcnn_odom.evaluation.scores``."""
        self.estimates[batch["name"]] = self.model.estimate_scans(batch["scans"])

    def on_test_epoch_end(self) -> None:
        """Collects the estimates of all processes; the first process saves them in ``estimates_file``."""
        self._gather_estimates()
        if self.estimates_file and self.global_rank == 0:
            self.estimates_file.write_bytes(pickle.dumps(self.estimates))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the fingerprints of the training to the checkpoint."""
        checkpoint |= {"fingerprint": self.fingerprint, "code": self.code}

    def _gather_estimates(self) -> None:
        """Exchanges estimates among processes; a drive that two processes have estimated counts once."""
        if self.trainer.world_size > 1:
            shares: list[Any] = [None] * self.trainer.world_size
            torch.distributed.all_gather_object(shares, self.estimates)
            self.estimates = {name: steps for share in shares for name, steps in share.items()}

    def configure_optimizers(self) -> Any:
        """Adam with a one-cycle learning rate over the whole training.

        The schedule also changes Adam's beta1: from 0.95 down to 0.85 while the rate rises, and back while it
        falls (``cycle_momentum``, PyTorch's default).
        """
        rate = self.model.options["learning_rate"]
        optimizer = torch.optim.Adam([p for p in self.parameters() if p.requires_grad], lr=rate, fused=True)
        # Not `trainer.estimated_stepping_batches`, which creates the loader before the checkpoint sets its
        # position.
        assert self.trainer.max_epochs is not None
        steps = self.trainer.max_epochs * steps_per_epoch(self.trainer.limit_train_batches, self._datamodule)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def steps_per_epoch(limit: float | None, data: OdometryDataModule) -> int:
    """Number of steps in an epoch; a whole number as ``trainer.limit_train_batches`` may reduce it."""
    return min(limit, data.batches_per_epoch) if isinstance(limit, int) else data.batches_per_epoch


class PaperModule(OdometryModule):
    """A module for one model, which the class attribute ``variant`` names."""

    def __init__(self, options: Settings, sensor: Settings, lengths: list[float]) -> None:
        super().__init__(self.variant, options, sensor, lengths)


class CNNRegression(PaperModule):
    """The CNN with regression of distance and rotation (eq. 3) from one pair of scans."""

    variant = "cnn_reg"


class CNNClassification(PaperModule):
    """The CNN with classification of the rotation (eq. 4): the first stage of both recurrent networks."""

    variant = "cnn_cls"


class RCNNRegression(PaperModule):
    """The RCNN with regression (eq. 3), the best network of the paper."""

    variant = "rcnn_reg"


class RCNNClassification(PaperModule):
    """The RCNN with classification of the rotation (eq. 4)."""

    variant = "rcnn_cls"


def module_for(variant: str) -> Callable[[Settings, Settings, list[float]], OdometryModule]:
    """The class or function that builds the module of a model from its options, sensor and lengths."""
    named = {module.variant: module for module in PaperModule.__subclasses__()}
    return named.get(variant) or partial(OdometryModule, variant)
