"""What every estimator is: scans in, steps out; trained or not. Needs numpy alone.

A model is one file in this package and one in ``conf/model``; docs/extending.md writes one.
"""

import inspect
from abc import ABC, abstractmethod
from dataclasses import fields, is_dataclass
from itertools import chain
from typing import Any, ClassVar

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import Steps
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.pairs import PairTracker

# Also what a model is made of in a stream, so that one import brings all of the contract.
from rcnn_odom.models.streaming import Description as Description
from rcnn_odom.models.streaming import Registered as Registered
from rcnn_odom.models.streaming import ScanTracker as ScanTracker
from rcnn_odom.models.streaming import Stepper as Stepper
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.registry import choose, collect, modules_in


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
        uses_depth_vectors: whether it looks at ``Drive.scans``, which are not made for it otherwise.
        deskew: ``data.deskew``, for a model of whole scans: whether it takes the motion of the laser within a
            scan out of it, ``on`` or ``off``; ``auto``: unless ``Drive.is_compensated``.
    """

    name: ClassVar[str]
    Options: ClassVar[type]
    trains: ClassVar[bool] = False
    uses_depth_vectors: ClassVar[bool] = True
    deskew: str = "auto"
    sensor: Sensor

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__()
        self.options, self.sensor = options, sensor

    @abstractmethod
    def estimate(self, drive: Drive) -> Steps:
        """The steps of one whole drive."""

    def stepper(self) -> Stepper:
        """The same one pair of encoded scans after the other; a model that looks at whole scans has none."""
        raise NotImplementedError(f"{self.name} looks at whole scans; it has a tracker")

    def tracker(self) -> ScanTracker:
        """The same one scan after the other; a model that looks at whole scans has one of its own."""
        return PairTracker(self.stepper())


NEEDED = ("name", "Options", "estimate")
NEEDED_IN_A_STREAM = ("stepper", "tracker")
"""One of them is needed."""
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
    if not any(getattr(model, each, None) not in (None, getattr(Model, each)) for each in NEEDED_IN_A_STREAM):
        missing.append(" or ".join(NEEDED_IN_A_STREAM))
    if not missing and is_dataclass(model.Options) and trains:
        given = {each.name for each in fields(model.Options)}
        wanted = RECIPE | ({"first_stage"} if model.first_stage else set())
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
    for module in chain(modules_in("rcnn_odom.models"), modules_in("rcnn_odom.models.peers")):
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
