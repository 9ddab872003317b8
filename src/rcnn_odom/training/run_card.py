"""Text cards for TensorBoard, in Markdown: what a run is, and the test scores of its best checkpoint."""

import platform
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig

from rcnn_odom import __version__
from rcnn_odom.evaluation.metrics import Report, all_metrics
from rcnn_odom.evaluation.run_folder import Settings
from rcnn_odom.evaluation.scores import percent
from rcnn_odom.evaluation.sweep_report.document import DASH, code, duration, markdown_table
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.training.datamodule import OdometryDataModule
from rcnn_odom.training.modules import OdometryModule, steps_per_epoch
from rcnn_odom.training.provenance import find_commit, read_processor_name

GUIDE = """### How to read the charts

- The horizontal axis "step" counts training steps. One step is one batch.
- **Training** shows the loss, which the training minimises, its parts, and the learning rate.
- **Validation** shows scores of whole validation drives after each epoch. The checkpoint with the lowest
  mean drift is kept as the best one.
- **Best checkpoint** shows the scores of that checkpoint after the training, on the validation and the test
  drives. They are single points. To compare those of several runs, use the tabs *Time Series* or *HParams*:
  the axes in *Scalars* may leave them out.
- **Drift** is the error at the end of a segment of a drive, divided by the length of the segment, as in the
  KITTI benchmark; the mean over all segments. Lower is better. The other **errors** are those of single
  frames, over all drives.
- The tab *Images* shows the test drives, *HParams* compares the options and scores of several runs, and
  *Custom Scalars* draws curves that belong together in one chart."""

BASELINES = {
    "mean_motion": "`mean_motion` repeats the mean step of the training drives.",
    "held_motion": "`held_motion` starts at rest and repeats its last step, so that it never moves.",
    "wheel_odometry": "`wheel_odometry` is the odometry of the robot's wheels.",
}
FLOOR = """The floor is the drift of the true motion after its reduction to two numbers a frame, distance and
change of heading."""

FILES = "metrics.json", "checkpoints/best.ckpt", "trajectories", "figures", "config.yaml", "train.log"
"""Files and folders with the results of a run."""
COMMAND_WIDTH = 90
"""Maximum length of a line of the command, unless an option is longer; TensorBoard cuts longer lines."""


def find_command() -> str | None:
    """The command of the present Hydra job, in short lines for a shell; None outside of Hydra."""
    if not HydraConfig.initialized():
        return None
    script = "python train.py" if Path(sys.argv[0]).name == "train.py" else "rcnn-odom train"
    lines = [script]
    for override in map(shlex.quote, HydraConfig.get().overrides.task):
        if len(lines[-1]) + len(override) < COMMAND_WIDTH:
            lines[-1] += f" {override}"
        else:
            lines.append(f"  {override}")
    return " \\\n".join(lines)


def name_processor(device: torch.device) -> str:
    """The name of the GPU, or of the processor and its number of threads."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    threads = torch.get_num_threads()
    return f"{read_processor_name()}, {threads} {'thread' if threads == 1 else 'threads'}"


def describe_run(
    settings: Settings,
    command: str | None,
    trainer: L.Trainer,
    module: OdometryModule,
    datamodule: OdometryDataModule,
    same_as: str | None = None,
) -> str:
    """Formats the card that says what a run is.

    Args:
        settings: settings of the run.
        command: the command that started it, see :func:`find_command`; None if it is unknown.
        trainer: the Trainer of the run.
        module: the module of the run.
        datamodule: the data of the run, loaded.
        same_as: folder of another run that has finished the same training, whose weights are used; None: this
            run is trained.
    """
    data, model = settings["data"], settings["model"]
    commit = find_commit()
    rows = {
        "Model": _describe_model(model, module),
        "Data": f"{code(data['name'])}, read as {code(data['reader']['format'])}",
        "Training drives": _describe_drives(data["train"], datamodule.drives["train"]),
        "Validation drives": _describe_drives(data["val"], datamodule.drives["val"]),
        "Test drives": _describe_drives(data["test"], datamodule.drives["test"]),
        "Laser": _describe_sensor(Sensor(**data["sensor"])),
        "Seed": str(settings["seed"]),
        "Length": _describe_length(settings, trainer, datamodule),
        "Processor": _describe_devices(trainer),
        "Precision": f"{code(trainer.precision)} in training; scores are always computed in fp32",
        "Code": f"rcnn-odom {__version__}, {f'commit {commit}' if commit else 'not from a Git checkout'}; "
        f"PyTorch {torch.__version__}, Lightning {L.__version__}, Python {platform.python_version()}",
        "Results": f"in {code(settings['run_dir'])}: {', '.join(map(code, FILES))}",
    }
    if same_as:
        rows["Weights"] = (
            f"those of {code(same_as)}, which has finished the same training; this run trains none"
        )
    elif trainer.global_step:
        rows["Start"] = f"continues an interrupted training after step {trainer.global_step:,}"
    if datamodule.fresh_epochs:
        rows["Training drives"] += ". Every epoch after the first has new simulated drives of these lengths"
    lines = "\n".join(f"- **{name}:** {text}" for name, text in rows.items())
    started = "It was started from Python, not by a command."
    if command:
        started = "It was started by\n\n" + "\n".join(f"    {line}" for line in command.splitlines())
    return f"### What this run is\n\n{started}\n\n{lines}\n\n{GUIDE}\n"


def _describe_model(model: Settings, module: OdometryModule) -> str:
    """Name and number of weights of a model, and where its training begins."""
    parameters = list(module.parameters())
    count, trained = sum(p.numel() for p in parameters), sum(p.numel() for p in parameters if p.requires_grad)
    part = "" if trained == count else f", of which {trained:,} are trained"
    begin = (
        f"; training begins with the weights of {code(model['pretrained'])}"
        if model.get("pretrained")
        else ""
    )
    return f"{code(model['variant'])} with {count:,} weights{part}{begin}"


def _describe_drives(names: Sequence[str], drives: Sequence[Drive]) -> str:
    """Names of drives, with their total number of scans and length."""
    metres = sum(float(np.nansum(np.hypot(*drive.steps[:, :2].T))) for drive in drives)
    return f"{', '.join(map(code, names))} ({sum(map(len, drives)):,} scans, {metres:,.0f} m)"


def _describe_sensor(sensor: Sensor) -> str:
    """Field of view, bins and range of a laser."""
    facing = f", facing {sensor.facing_deg:g}°" if sensor.facing_deg else ""
    return (
        f"field of view {sensor.field_of_view_deg:g}°{facing}, {sensor.bins:,} bins of "
        f"{sensor.resolution_deg:g}°, ranges up to {sensor.max_range:g} m"
    )


def _describe_length(settings: Settings, trainer: L.Trainer, datamodule: OdometryDataModule) -> str:
    """Number of steps and epochs, and the size of a batch."""
    each, epochs = steps_per_epoch(trainer.limit_train_batches, datamodule), trainer.max_epochs or 0
    limit = settings["trainer"].get("max_time")
    until = f"; stops after {limit} (trainer.max_time)" if limit else ""
    window = datamodule.window
    windows = (
        f"windows of {window} consecutive pairs of scans" if window > 1 else "pairs of consecutive scans"
    )
    steps = f"{epochs * each:,} steps in {epochs:,} epochs"
    return f"{steps}; a step is a batch of {datamodule.batch_size} {windows}{until}"


def _describe_devices(trainer: L.Trainer) -> str:
    """Number of processes and the device of this one."""
    count = f"{trainer.world_size} processes, each on " if trainer.world_size > 1 else ""
    return count + name_processor(trainer.strategy.root_device)


def describe_results(settings: Settings, metrics: Report) -> str:
    """Formats the card with the test scores.

    Args:
        settings: settings of the run.
        metrics: content of ``metrics.json``.
    """
    name, test, training = metrics["variant"], metrics["test"], metrics["training"]
    methods = {name: test, **metrics["baselines"]}
    done = f"{training['epochs']:,} epochs ({training['steps']:,} steps) in {duration(training['seconds'])}"
    parts = [
        "### How good the best checkpoint is",
        f"The drift of {code(name)} is **{percent(test['drift'])} %** on the test drives and "
        f"{percent(metrics['val']['drift'])} % on the validation drives (means over the drives, lower is "
        f"better). Training took {done}.",
        "#### Test drift in % by drive",
        drift_table(methods, test),
        _explain_methods(methods),
        "#### Test drift in % by length of the segments",
        length_table(name, test),
        "#### Other scores over all test drives",
        scores_table(methods),
    ]
    if "stopped_by" in training:
        parts.insert(
            1,
            f"**This training is not finished.** {training['stopped_by']} stopped it after "
            f"{training['epochs']} of {settings['model']['epochs']} epochs. The same command continues it.",
        )
    return "\n\n".join(parts) + "\n"


def _explain_methods(methods: Mapping[str, Report]) -> str:
    """Sentences about the rows of the drift table."""
    sentences = [BASELINES[name] for name in methods if name in BASELINES]
    reduced = [name for name in methods if name.endswith("_two_numbers")]
    more = [f"{code(name)} is the network's estimate after the same reduction." for name in reduced]
    return " ".join([*sentences, FLOOR, *more])


def drift_table(methods: Mapping[str, Report], test: Report) -> str:
    """Formats the drift with a row for each method and a column for each test drive.

    Args:
        methods: results of :func:`rcnn_odom.evaluation.scores.score_all` by the name of the method.
        test: the results of one of them, for the floor and the number of segments.
    """
    drives = list(test["sequences"])
    rows = [
        [
            name,
            *(percent(one["sequences"][drive]["drift"]["t_err"]) for drive in drives),
            percent(one["drift"]),
        ]
        for name, one in methods.items()
    ]
    floors = [percent(test["sequences"][drive]["floor"]["t_err"]) for drive in drives]
    counts = [str(test["sequences"][drive]["drift"]["segments"]) for drive in drives]
    rows += [["floor of two numbers", *floors, percent(test["floor"])], ["number of segments", *counts, DASH]]
    return markdown_table(["method", *(f"drive {drive}" for drive in drives), "mean"], rows)


def length_table(name: str, test: Report) -> str:
    """Formats the drift in % with a row for each test drive and a column for each length of segments."""
    lengths = segment_lengths(test)
    rows = []
    for drive, scores in test["sequences"].items():
        parts = scores["drift"]["per_length"]
        rows.append([f"drive {drive}", *(percent(parts.get(each, {}).get("t_err")) for each in lengths)])
    return markdown_table([name, *(f"{each} m" for each in lengths)], rows)


def segment_lengths(test: Report) -> list[str]:
    """The lengths of segments that exist in a drive, ascending, as in ``metrics.json``.

    >>> drives = {"05": {"drift": {"per_length": {"10": {}, "5": {}}}}}
    >>> segment_lengths({"sequences": drives})
    ['5', '10']
    """
    found = {each for scores in test["sequences"].values() for each in scores["drift"]["per_length"]}
    return sorted(found, key=float)


def scores_table(methods: Mapping[str, Report]) -> str:
    """Formats the metrics without drift, with a row for each metric and a column for each method."""
    metrics: list[Any] = [metric for metric in all_metrics().values() if metric.name != "drift"]
    rows = [
        [
            f"{metric.title} ({metric.unit})",
            *(metric.show(one["metrics"][metric.name]) for one in methods.values()),
        ]
        for metric in metrics
    ]
    return markdown_table(["score", *methods], rows)
