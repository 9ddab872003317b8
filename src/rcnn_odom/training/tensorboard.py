"""What TensorBoard shows of a run: names of curves and figures, text cards, charts, the row in HParams."""

import re
from typing import TYPE_CHECKING, Any, cast

import lightning as L
import numpy as np
import numpy.typing as npt
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from torch.utils.tensorboard.summary import hparams, text

from rcnn_odom.evaluation.figures import draw_pixels, new_run_figure
from rcnn_odom.evaluation.metrics import DRIFT, Report, all_metrics
from rcnn_odom.evaluation.run_folder import Settings, flat
from rcnn_odom.training.modules import OdometryModule
from rcnn_odom.training.run_card import describe_results, describe_run, find_command, segment_lengths

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# TensorBoard sorts names and makes a group of those with the same text before the first slash. Names must not
# have parentheses: Custom Scalars would draw no line, since it looks for a run's name in them.
EACH_EPOCH = "Training: mean of each epoch/"
EVERY_10_STEPS = "Training: every 10 steps/"
VALIDATION = "Validation: after each epoch/"
BEST_DRIFT = "Best checkpoint: drift/"
BEST_OTHERS = "Best checkpoint: other test scores/"
FIGURES = "Test of the best checkpoint/"
"""Groups of scalars and figures."""
ALL_DRIVES = "all drives"

LEARNING_RATE = f"{EVERY_10_STEPS}learning rate"
EPOCH = f"{EACH_EPOCH}number of the epoch, from 0"
TEST_DRIFT = f"{BEST_DRIFT}test drift in %, {ALL_DRIVES}"
VALIDATION_DRIFT = f"{BEST_DRIFT}validation drift in %, {ALL_DRIVES}"
RUN_CARD, RESULTS_CARD = "About this run", "Test results"

TITLES = {
    "drift": "drift",
    "r_err_deg_per_m": "rotational drift",
    "rotation_deg_per_m": "rotational drift",
    "distance_mae_m": "mean absolute distance error",
    "distance_bias_m": "mean signed distance error",
    "distance_max_m": "largest distance error",
    "heading_mae_deg": "mean absolute heading error",
    "heading_bias_deg": "mean signed heading error",
    "heading_max_deg": "largest heading error",
}
"""Names of the project's own metrics; other metrics are shown by their titles."""

WITH_DRIVES = "drift", "r_err_deg_per_m"
"""Validation scores that are also logged for each drive."""

FIGURE_TITLES = {"trajectory": "estimated and true path", "motion": "rotation and translation of each frame"}
"""Content of the figures of a single drive, by the end of the file's name."""

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
"""Settings that do not affect the result, or are shown under another name."""
REPEATED = (
    *("model.apply", "model.first_stage.apply", "model.first_stage.kernel_size"),
    *("model.first_stage.pooling", "model.first_stage.rotation_classes"),
)
"""Settings that have the same value as another one."""

CHOSEN_AS = {"model.variant": "model", "data.name": "data"}
"""Settings whose column gets the name of the choice on the command line, to be sorted before its options."""


def training_tag(group: str, name: str) -> str:
    """The name of a training curve in TensorBoard, from the model's name of the value.

    >>> training_tag(EACH_EPOCH, "loss"), training_tag(EVERY_10_STEPS, "loss_rotation")
    ('Training: mean of each epoch/loss', 'Training: every 10 steps/loss, part rotation')
    """
    words = name.removeprefix("loss_").replace("_", " ")
    return f"{group}loss, part {words}" if name.startswith("loss_") else group + words


def score_tag(group: str, metric: str, drive: str | None = None) -> str:
    """The name of a score in TensorBoard, with its unit.

    Args:
        group: group of scalars.
        metric: name of the metric in ``metrics.json``, or ``r_err_deg_per_m``.
        drive: name of a drive, or ``ALL_DRIVES``; None if single drives have no such score.

    >>> score_tag(VALIDATION, "drift", "10")
    'Validation: after each epoch/drift in %, drive 10'
    >>> score_tag(VALIDATION, "distance_mae_m")
    'Validation: after each epoch/mean absolute distance error in m'
    """
    known = all_metrics()
    title, unit = TITLES.get(metric, metric), "deg/m" if metric == "r_err_deg_per_m" else ""
    if metric in known:
        title, unit = TITLES.get(metric) or known[metric].title, known[metric].unit
    place = "" if drive is None else f", {ALL_DRIVES if drive == ALL_DRIVES else f'drive {drive}'}"
    return _without_parentheses(f"{group}{title}{f' in {unit}' if unit else ''}{place}")


def _without_parentheses(tag: str) -> str:
    """Replaces parentheses, for which Custom Scalars would draw no line."""
    return tag.replace("(", "[").replace(")", "]")


def validation_scalars(values: dict[str, float]) -> dict[str, float]:
    """Values of ``trainer.callback_metrics`` by their names in TensorBoard, in the shown units.

    >>> validation_scalars({"val/drift": 0.02})
    {'Validation: after each epoch/drift in %, all drives': 2.0}
    """
    scalars, known = {}, all_metrics()
    for key, value in values.items():
        split, _, name = key.partition("/")
        metric, _, drive = name.partition("/")
        if split == "val":
            scale = known[metric].scale if metric in known else 1.0
            place = drive or (ALL_DRIVES if metric in WITH_DRIVES else None)
            scalars[score_tag(VALIDATION, metric, place)] = scale * value
    return scalars


class OneFileLogger(TensorBoardLogger):
    """Keeps the file of a run open from training to scoring.

    Lightning would open a second one for the scores. TensorBoard reads the files of one second in the order
    of their names, where 10 comes before 9, and then drops the scores as those of an earlier attempt.
    """

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Lightning's hook after training, validation and test."""
        if self._experiment is not None:
            self.experiment.flush()


class Dashboard(Callback):
    """Writes the text card of a run and the layout of the custom scalars when a training starts.

    Args:
        settings: settings of the run.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        # Processes that are started for training do not have Hydra's configuration.
        self.command = find_command()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Lightning's hook before the first step."""
        if not trainer.is_global_zero:
            return
        assert isinstance(trainer.logger, TensorBoardLogger)
        # A resumed run logs the steps after its last checkpoint again. This event drops the older points.
        start = SessionLog(status=SessionLog.START)
        trainer.logger.experiment.file_writer.add_event(Event(step=trainer.global_step, session_log=start))
        module = cast(OdometryModule, pl_module)
        datamodule = trainer.datamodule  # type: ignore[attr-defined]
        card = describe_run(self.settings, self.command, trainer, module, datamodule)
        log_start(trainer.logger, card, trainer.global_step)


def log_start(logger: TensorBoardLogger, card: str, step: int = 0) -> None:
    """Writes the text card of a run and the layout of the custom scalars.

    Args:
        logger: logger of the run.
        card: the result of :func:`rcnn_odom.training.run_card.describe_run`.
        step: number of training steps so far.
    """
    logger.experiment.add_custom_scalars(custom_scalars())
    log_text(logger, RUN_CARD, card, step)


def custom_scalars() -> dict[str, dict[str, list[Any]]]:
    """The charts of the tab Custom Scalars by group and title, with the patterns of their scalars."""

    def chart(*patterns: str) -> list[Any]:
        return ["Multiline", list(patterns)]

    epoch, validation, best = re.escape(EACH_EPOCH), re.escape(VALIDATION), re.escape(BEST_DRIFT)
    others = {
        f"{TITLES.get(name, metric.title)} ({metric.unit})": chart(
            re.escape(score_tag(VALIDATION, name)), re.escape(score_tag(BEST_OTHERS, name))
        )
        for name, metric in all_metrics().items()
        if metric.in_training and name != DRIFT.name
    }
    return {
        "Loss over training steps": {
            "loss, mean of each epoch": chart(f"{epoch}loss$"),
            "parts of the loss, mean of each epoch": chart(f"{epoch}loss, part"),
        },
        "Drift (%) over training steps": {
            "validation: all drives and each of them": chart(f"{validation}drift in"),
            "test of the best checkpoint": chart(f"{best}test"),
        },
        "Other scores over training steps": others,
    }


def log_text(logger: TensorBoardLogger, tag: str, markdown: str, step: int) -> None:
    """Writes a text card; torch's ``add_text`` would append ``/text_summary`` to its name."""
    summary = text(tag, markdown)
    summary.value[0].tag = tag
    logger.experiment.file_writer.add_summary(summary, step)


def figure_tag(name: str) -> str:
    """The name of a figure in TensorBoard, from the name of its file.

    >>> figure_tag("test/05_trajectory")
    'Test of the best checkpoint/drive 05: estimated and true path'
    """
    name = name.removeprefix("test/")
    drive, _, kind = name.rpartition("_")
    if drive and kind in FIGURE_TITLES:
        return f"{FIGURES}drive {drive}: {FIGURE_TITLES[kind]}"
    known = {"coverage": "errors within the estimated uncertainty"}
    return f"{FIGURES}{ALL_DRIVES}: {known.get(name, name.replace('_', ' '))}"


def log_figure(logger: TensorBoardLogger, step: int, name: str, pixels: npt.NDArray[np.uint8]) -> None:
    """Writes a figure.

    Args:
        logger: logger of the run.
        step: number of training steps.
        name: name of the figure's file.
        pixels: (height, width, 3) of the figure.
    """
    logger.experiment.add_image(figure_tag(name), pixels, step, dataformats="HWC")


def length_figure(name: str, test: Report) -> "Figure":
    """Draws the drift over the length of the segments, with a line for each test drive.

    Args:
        name: name of the model.
        test: the entry ``test`` of ``metrics.json``.
    """
    figure, (axes,) = new_run_figure(f"{name}: test drift by length")
    lengths = segment_lengths(test)
    for drive, scores in test["sequences"].items():
        parts = scores["drift"]["per_length"]
        shown = [each for each in lengths if each in parts]
        axes.plot(
            [float(each) for each in shown],
            [DRIFT.scale * parts[each]["t_err"] for each in shown],
            marker="o",
            label=f"drive {drive}",
        )
    axes.set(xlabel="length of the segments (m)", ylabel="drift (%)")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def log_results(logger: TensorBoardLogger, settings: Settings, metrics: Report) -> None:
    """Writes the text card of the test scores and the figure of the drift by length.

    Args:
        logger: logger of the run.
        settings: settings of the run.
        metrics: content of ``metrics.json``.
    """
    step, test = metrics["training"]["steps"], metrics["test"]
    log_text(logger, RESULTS_CARD, describe_results(settings, metrics), step)
    if segment_lengths(test):
        figure = length_figure(metrics["variant"], test)
        log_figure(logger, step, "test_drift_by_length", draw_pixels(figure))


def log_run(logger: TensorBoardLogger, settings: Settings, metrics: Report) -> None:
    """Writes the row of a finished run in the HParams tab: settings and scores; also logs the scores.

    Lightning also writes a summary of the "experiment". Then TensorBoard takes the columns from the first
    run, in alphabetical order, and shows five of them. Without that summary it compares all runs and shows
    the settings that differ first.

    Args:
        logger: logger of the run.
        settings: settings of the run.
        metrics: content of ``metrics.json``.
    """
    row = {
        CHOSEN_AS.get(name, name): value if type(value) in (int, float) else str(value)
        for name, value in flat(settings).items()
        if not name.startswith(NOT_IN_ROW + REPEATED)
    }
    scores, step = best_scalars(metrics), metrics["training"]["steps"]
    logger.log_metrics(scores, step)
    _, *summaries = hparams(row, scores)
    for summary in summaries:
        logger.experiment.file_writer.add_summary(summary, step)


def best_scalars(metrics: Report) -> dict[str, float]:
    """The scores of the best checkpoint by their names in TensorBoard, in the shown units.

    Args:
        metrics: content of ``metrics.json``.
    """
    known, test = all_metrics(), metrics["test"]
    # The validation drift has a name of its own, so that the validation curve gets no additional point.
    scores = {VALIDATION_DRIFT: (DRIFT, metrics["val"]["drift"]), TEST_DRIFT: (DRIFT, test["drift"])}
    for drive, scored in test["sequences"].items():
        tag = _without_parentheses(f"{BEST_DRIFT}test drift in %, drive {drive}")
        scores[tag] = DRIFT, scored["drift"]["t_err"]
    for name, value in test["metrics"].items():
        if name != DRIFT.name:
            scores[score_tag(BEST_OTHERS, name)] = known[name], value
    return {tag: metric.scale * value for tag, (metric, value) in scores.items() if value is not None}
