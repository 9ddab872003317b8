"""Options of Lightning's Trainer: those that are supported, and what to use instead of the others."""

from dataclasses import dataclass, fields
from datetime import timedelta
from typing import Any

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import Settings
from rcnn_odom.options import option
from rcnn_odom.training.cluster import World, find_world

_VALIDATION = (
    "validation uses whole drives after every epoch, since it chooses the best checkpoint; leave it out"
)
_EPOCHS = "the length of a training belongs to the recipe; set model.epochs"
_FOLDER = "a run writes into its own folder; set run_dir"
_LOG = "TensorBoard gets a point every 10 steps and every epoch; leave it out"
_CHECKPOINTS = "a training saves its last and its best checkpoint automatically; leave it out"
_OWN = "the code of this project sets it; leave it out"

INSTEAD = {
    **dict.fromkeys(
        ("limit_val_batches", "check_val_every_n_epoch", "val_check_interval", "num_sanity_val_steps"),
        _VALIDATION,
    ),
    "limit_test_batches": "whole drives are scored; choose fewer drives, data.test=[...]",
    "limit_predict_batches": "there is no prediction apart from the test; leave it out",
    "overfit_batches": "choose the training and validation drives; set data.train=[...] data.val=[...]",
    **dict.fromkeys(("max_epochs", "min_epochs", "max_steps", "min_steps"), _EPOCHS),
    "accumulate_grad_batches": "a step of the recipe is one batch; set model.batch_size",
    "default_root_dir": _FOLDER,
    **dict.fromkeys(("logger", "log_every_n_steps", "enable_autolog_hparams", "model_registry"), _LOG),
    "enable_checkpointing": _CHECKPOINTS,
    **dict.fromkeys(("callbacks", "plugins", "use_distributed_sampler"), _OWN),
    **dict.fromkeys(
        ("enable_progress_bar", "enable_model_summary"), "the log has a line for each epoch; leave it out"
    ),
    "reload_dataloaders_every_n_epochs": "data.fresh_worlds gives new drives in every epoch; leave it out",
    **dict.fromkeys(
        ("profiler", "barebones"),
        "make bench-train measures the speed, or use a profiler for the whole command; leave it out",
    ),
    "inference_mode": "drives are always scored without gradients; leave it out",
}
"""Refused options of Lightning, each with the reason and what to do instead."""

ONLY_TRAINING = ("fast_dev_run", "limit_train_batches", "max_time")
"""Options that have no meaning for ``evaluate.py``."""
WITHOUT_EFFECT = ("max_time",)
"""Options that do not change the result of a complete training."""


def max_time_in_seconds(max_time: Any) -> float | None:
    """Converts ``trainer.max_time`` to seconds; None if it is not valid.

    >>> max_time_in_seconds("00:00:01:30"), max_time_in_seconds({"minutes": 2})
    (90.0, 120.0)
    """
    if isinstance(max_time, str):
        parts = [int(part) if part.isdecimal() else -1 for part in max_time.strip().split(":")]
        if len(parts) != 4 or min(parts) < 0:
            return None
        max_time = dict(zip(("days", "hours", "minutes", "seconds"), parts, strict=True))
    try:
        seconds = timedelta(**max_time).total_seconds()
    except (TypeError, OverflowError, ValueError):
        return None
    return seconds if seconds > 0 else None


def _are_devices(devices: Any) -> bool:
    """Whether this is a number of devices, a list of their numbers, or ``auto``."""
    if isinstance(devices, list):
        return bool(devices) and all(type(one) is int and one >= 0 for one in devices)
    return devices == "auto" if isinstance(devices, str) else bool(devices >= 1)


@dataclass(kw_only=True)
class TrainerOptions:
    """The supported options ``trainer``; fields with a default need a ``+`` on the command line."""

    accelerator: str
    devices: int | str | list[Any] = option(  # noqa: RUF009
        fits=_are_devices,
        wanted="a number of devices, 1 or more, or a list of device numbers, for instance [0,1]",
    )
    precision: str = option(choices=("auto", "bf16-mixed", "32-true"))
    gradient_clip_val: float | None = option(above=0, wanted="null for no clipping, or a number above 0")
    gradient_clip_algorithm: str = option(default="norm", choices=("norm",))
    strategy: str = option(default="auto", choices=("auto", "ddp_spawn"))
    num_nodes: int | None = option(default=None, above=0)
    deterministic: bool | str | None = option(default=None, choices=("warn",), wanted="true, false or warn")
    benchmark: bool | None = option(default=None)
    detect_anomaly: bool = option(default=False)
    sync_batchnorm: bool = option(default=False)
    limit_train_batches: int | None = option(
        default=None, above=0, wanted="a whole number of batches above 0"
    )
    fast_dev_run: bool | int | None = option(
        default=None, least=0, wanted="true, or a number of training batches"
    )
    max_time: str | dict[str, Any] | None = option(  # noqa: RUF009
        default=None,
        fits=lambda max_time: max_time_in_seconds(max_time) is not None,
        wanted="a time above 0, for instance 00:01:30:00 (days, hours, minutes, seconds) or {minutes: 90}",
    )


def explain_refusal(name: str) -> str | None:
    """Explains why the option ``trainer.NAME`` is not supported; None if it is.

    >>> explain_refusal("accelerator") is None, explain_refusal("max_epochs")
    (True, 'trainer.max_epochs: the length of a training belongs to the recipe; set model.epochs')
    """
    known = sorted(each.name for each in fields(TrainerOptions))
    if name in known:
        return None
    if name in INSTEAD:
        return f"trainer.{name}: {INSTEAD[name]}"
    return f"trainer.{name}: there is no such option; there are {', '.join(known)}"


def refuse_names(trainer: Settings) -> None:
    """Checks the names of all options of the Trainer.

    Raises:
        InputError: an option is not supported.
    """
    for name in trainer:
        if reason := explain_refusal(str(name)):
            raise InputError(reason)


def apply_fast_dev_run(settings: Settings) -> None:
    """Replaces ``fast_dev_run`` by one epoch with that number of batches in each stage, in place.

    So the saved configuration says what was trained. Options that are null or false are removed.
    """
    trainer, model = settings.get("trainer") or {}, settings.get("model") or {}
    batches = int(trainer.get("fast_dev_run") or 0)
    for name in ONLY_TRAINING:
        if not trainer.get(name):
            trainer.pop(name, None)
    if batches and "epochs" in model:
        trainer.pop("fast_dev_run")
        trainer["limit_train_batches"] = batches
        model["epochs"] = 1
        if isinstance(first_stage := model.get("first_stage"), dict):
            first_stage["epochs"] = 1


def processes_per_node(default: int) -> int:
    """Number of processes that torchrun or Slurm has started on each node; otherwise the default."""
    try:
        world = find_world()
    except InputError:  # The command reports the error later.
        return default
    return world.per_node if world else default


def check_devices(trainer: Settings) -> None:
    """Compares the devices and nodes with the started processes, and sets ``num_nodes``.

    Raises:
        InputError: the numbers do not match.
    """
    world = find_world()
    if not trainer.get("num_nodes"):
        trainer.pop("num_nodes", None)
    nodes, devices = trainer.get("num_nodes"), trainer.get("devices", 1)
    if world is not None:
        _compare(world, devices, nodes or world.nodes, trainer.get("strategy", "auto"))
        nodes = world.nodes
    elif nodes and nodes > 1:
        raise InputError(
            f"trainer.num_nodes={nodes}: no process runs on other nodes; start the command on each node by "
            "torchrun or srun, or set trainer=ddp trainer.devices=... for one node"
        )
    trainer.pop("num_nodes", None)  # One node is the default.
    if nodes and nodes > 1:
        trainer["num_nodes"] = nodes


def _compare(world: World, devices: Any, nodes: int, strategy: str) -> None:
    """Compares the started processes with the options of the Trainer.

    Raises:
        InputError: they do not match.
    """
    if world.size > 1 and strategy == "auto":
        raise InputError(
            f"trainer.strategy=auto: {world.starter} has started {world.size} processes; set trainer=ddp "
            "to train in all of them"
        )
    count = len(devices) if isinstance(devices, list) else devices
    if (count, nodes) != (world.per_node, world.nodes):
        raise InputError(
            f"trainer.devices={devices} trainer.num_nodes={nodes}: {world.starter} has started {world.size} "
            f"processes, {world.per_node} on each node; set trainer.devices={world.per_node} "
            f"+trainer.num_nodes={world.nodes}, or leave both out"
        )


def refuse_options_of_training(trainer: Settings) -> None:
    """Checks the options of a command that does not train.

    Raises:
        InputError: an option is only for training.
    """
    for name in ONLY_TRAINING:
        if name in trainer:
            raise InputError(
                f"trainer.{name}: is an option of training, and nothing is trained; leave it out"
            )
