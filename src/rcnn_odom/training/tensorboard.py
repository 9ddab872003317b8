"""TensorBoard as a dashboard: the layout of its custom scalars, and a run's row of its HParams tab."""

from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from torch.utils.tensorboard.summary import hparams

from rcnn_odom.evaluation.metrics import all_metrics
from rcnn_odom.evaluation.run_folder import Settings, flat

LOSS_AND_DRIFT = {
    "Loss": {
        "loss": ["Multiline", ["train/loss_epoch"]],
        "parts of the loss": ["Multiline", ["train/loss_.*_epoch"]],
    },
    "Drift (ratio)": {
        "validation drift, the mean and each sequence": ["Multiline", ["val/drift.*"]],
        "test drift, the mean and each sequence": ["Multiline", ["drift/test.*"]],
    },
}
"""Groups of charts by title, each with patterns of the scalars in it."""

NOT_IN_ROW = (
    "run_dir",
    "outputs",
    "data.reader",
    "data.root",
    "data.reference",
    "data.workers",
    "data.keep_worlds",
    "trainer.max_time",
)
REPEATED = (
    *("model.apply", "model.first_stage.apply", "model.first_stage.kernel_size"),
    *("model.first_stage.pooling", "model.first_stage.rotation_classes"),
)
"""Settings that only repeat another one."""

CHOSEN_AS = {"model.variant": "model", "data.name": "data"}
"""Settings whose column has the name of the choice on the command line, and so comes before its parts."""


class Layout(Callback):
    """Tells TensorBoard which scalars belong together."""

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Called once, before the first scalar."""
        if not trainer.is_global_zero:
            return
        assert isinstance(trainer.logger, TensorBoardLogger)
        writer = trainer.logger.experiment
        others = {
            f"{metric.title} ({name})": ["Multiline", [f"(val|test)/{name}"]]
            for name, metric in all_metrics().items()
            if metric.in_training and name != "drift"
        }
        writer.add_custom_scalars({**LOSS_AND_DRIFT, "Other metrics": others})
        # A run that goes on, or begins again, will log what came after its last checkpoint once more.
        start = SessionLog(status=SessionLog.START)
        writer.file_writer.add_event(Event(step=trainer.global_step, session_log=start))


def log_run(logger: TensorBoardLogger, settings: Settings, metrics: dict[str, Any], step: int) -> None:
    """A finished run's row of the HParams tab: its settings, and drift as the metric; the scores as scalars.

    No summary of an "experiment" is written, as Lightning would: the columns of the first run would stand for
    those of all, in the order of the alphabet, and five are shown. Without it TensorBoard looks at all
    runs, and shows first the settings in which they differ.

    Args:
        logger: of the run.
        settings: of the run.
        metrics: with ``val`` and ``test`` of what ``metrics.json`` holds.
        step: training steps that it took.
    """
    row = {
        CHOSEN_AS.get(name, name): value if type(value) in (int, float) else str(value)
        for name, value in flat(settings).items()
        if not name.startswith(NOT_IN_ROW + REPEATED)
    }
    test = metrics["test"]
    # Not val/drift, whose curve another point would purge; and TensorBoard sorts metrics by the alphabet.
    scores = {"drift/validation": metrics["val"]["drift"], "drift/test": test["drift"]}
    for name, scored in test["sequences"].items():
        scores[f"drift/test/{name}"] = scored["drift"]["t_err"]
    scores |= {f"test/{name}": value for name, value in test["metrics"].items() if name != "drift"}
    known = {name: value for name, value in scores.items() if value is not None}
    logger.log_metrics(known, step)
    _, *summaries = hparams(row, known)
    for summary in summaries:
        logger.experiment.file_writer.add_summary(summary, step)
