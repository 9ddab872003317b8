"""What every estimator is: scans in, steps out; trained or not. Needs numpy alone.

A model is one file in this package and one in ``conf/model``; docs/extending.md writes one.
"""

import inspect
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, Step, Steps
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.registry import choose, collect, modules_in


@dataclass(frozen=True)
class Description:
    """What an odometer has to know of its model.

    Attributes:
        sensor: the laser as the model sees it: how scans are encoded for it.
        typical_step: root mean square of the training steps' x, y (metres) and heading (radians): how wrong
            a step may be that is not known at all. nan if unknown.
        least_filled: share of bins with a return below which a scan counts as sparse; nan if unknown.
        period: usual seconds between scans in training; nan if unknown.
    """

    sensor: Sensor
    typical_step: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    least_filled: float = np.nan
    period: float = np.nan


class Stepper(Protocol):
    """A model in a stream: it estimates one step after the other and carries its own state."""

    description: Description

    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """The step between two encoded scans (2, bins), the earlier first."""

    def reset(self) -> None:
        """Forgets all earlier pairs."""


@dataclass(frozen=True, eq=False)
class Registered:
    """What a model in a stream makes of one more scan.

    Attributes:
        step: from the scan before. Where nothing could be estimated, the last motion, with a covariance that
            says how wrong that may be.
        notes: what the step suffers from, each with its kind before a colon; empty: nothing.
        is_estimated: the step comes from this scan, at least in part; otherwise the last motion went on.
    """

    step: Step
    notes: tuple[str, ...] = ()
    is_estimated: bool = True


class ScanTracker(Protocol):
    """A model in a stream of whole scans: it keeps what it needs of those before."""

    period: float
    """Usual seconds between scans in training; nan: any."""

    def register(self, scan: Scan, periods: int = 1, seconds: float | None = None) -> Registered:
        """The step to one more scan.

        Args:
            scan: as the laser gave it.
            periods: usual times between scans since the last one, more than 1 over a gap.
            seconds: since the last one; None: unknown.
        """

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Takes a scan that cannot be compared with those before: the first, or after a clock was set.

        Returns:
            Notes as in :class:`Registered`.
        """

    def reset(self) -> None:
        """Forgets everything: the next scan is the first of another laser or of another place of it."""

    @property
    def has_seen(self) -> bool:
        """Whether there is a scan with returns that the next one can be compared with."""

    def returns(self) -> FloatArray:
        """Points (P, 2) in metres of the last scan in the laser's frame; empty where it was not used."""


class Model(ABC):
    """An estimator.

    Args:
        options: those of ``conf/model``, checked against ``Options``.
        sensor: how scans are encoded for it, ``data.sensor``.

    Attributes:
        name: by which ``model=NAME`` and checkpoints find it.
        Options: a dataclass of its options; see :mod:`rcnn_odom.options` for bounds.
        trains: whether ``train.py`` has something to do; then it is a
            :class:`rcnn_odom.models.trained.TrainedModel`.
    """

    name: ClassVar[str]
    Options: ClassVar[type]
    trains: ClassVar[bool] = False
    sensor: Sensor

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__()
        self.options, self.sensor = options, sensor

    @abstractmethod
    def estimate(self, drive: Drive) -> Steps:
        """The steps of one whole drive."""

    @abstractmethod
    def stepper(self) -> Stepper:
        """The same one pair of scans after the other."""


NEEDED = ("name", "Options", "estimate", "stepper")
NEEDED_TO_TRAIN = ("forward", "loss")
RECIPE = {"epochs", "learning_rate", "window", "batch_size"}
"""Options of every training, see :class:`rcnn_odom.models.trained.Recipe`."""


def check_model(name: str, model: Any) -> None:
    """Looks whether a class is a model.

    Raises:
        InputError: a part of the contract is missing; the message says which.
    """
    trains = getattr(model, "trains", False)
    needed = NEEDED + (NEEDED_TO_TRAIN if trains else ())
    abstract = getattr(model, "__abstractmethods__", ())
    missing = [part for part in needed if not hasattr(model, part) or part in abstract]
    if not missing and is_dataclass(model.Options) and trains:
        given = {each.name for each in fields(model.Options)}
        wanted = RECIPE | ({"first_stage", "pretrained"} if model.first_stage else set())
        missing = [f"the option {each}" for each in sorted(wanted - given)]
        if model.first_stage and model.take_first_stage.__qualname__.startswith("TrainedModel."):
            missing.append("take_first_stage")
    if missing:
        problem = f"lacks {', '.join(missing)}"
    elif not (inspect.isclass(model) and issubclass(model, Model)):
        problem = f"is no subclass of {Model.__name__}"
    elif not is_dataclass(model.Options):
        problem = "has Options that are no dataclass"
    elif model.name != name:
        problem = f"its class is named {model.name}; both must be the same"
    else:
        return
    raise InputError(f"model {name}: {problem}; docs/extending.md says what a model has")


def all_models(only: str | None = None) -> dict[str, type[Model]]:
    """Every model by its name; imports all of them, and so torch.

    Args:
        only: of those of other packages import the one of this name alone.

    Raises:
        InputError: two have the same name, or one lacks a part.
    """
    built_in: dict[str, type[Model]] = {}
    for module in modules_in("rcnn_odom.models"):
        for member in vars(module).values():
            is_model = inspect.isclass(member) and issubclass(member, Model)
            if is_model and member.__module__ == module.__name__ and "name" in vars(member):
                if member.name in built_in:
                    raise InputError(f"two models are called {member.name}; rename that of {module.__name__}")
                check_model(member.name, member)
                built_in[member.name] = member
    return collect("model", built_in, check_model, only)


def find_model(name: str) -> type[Model]:
    """The model of this name.

    Raises:
        InputError: there is none, or as :func:`all_models`.
    """
    found: type[Model] = choose("model", name, all_models(only=name))
    return found
