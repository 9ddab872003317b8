"""The interface of every estimator, trained or not: scans in, steps out. This module needs only numpy.

A model is one file in this package and one file in ``conf/model``; docs/extending.md has an example.
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

# The interfaces of a model in a stream, which are imported here so that this module has all interfaces.
from rcnn_odom.models.streaming import Description as Description
from rcnn_odom.models.streaming import Registered as Registered
from rcnn_odom.models.streaming import ScanTracker as ScanTracker
from rcnn_odom.models.streaming import Stepper as Stepper
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.registry import choose, collect, modules_in


class Model(ABC):
    """Base class of all estimators.

    Args:
        options: the options of ``conf/model``, checked against ``Options``.
        sensor: defines how scans are encoded for the model (``data.sensor``).

    Attributes:
        name: the name in ``model=NAME`` and in checkpoints.
        Options: a dataclass of the options; see :mod:`rcnn_odom.options` for bounds of their values.
        trains: whether the model can be trained by ``train.py``; then it is a subclass of
            :class:`rcnn_odom.models.trained.TrainedModel`.
        uses_depth_vectors: whether the model uses ``Drive.scans``; otherwise scans are not encoded for it.
        deskew: ``data.deskew``, for models of whole scans: ``on`` or ``off``, whether the model corrects
            scans for the motion of the laser during the scan; ``auto``: unless ``Drive.is_compensated``.
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
        """The steps of a whole drive."""

    def stepper(self) -> Stepper:
        """The model in a stream of encoded scans, one pair after the other.

        Raises:
            NotImplementedError: the model uses whole scans; it has only a tracker.
        """
        raise NotImplementedError(f"{self.name} uses whole scans; call tracker() instead of stepper()")

    def tracker(self) -> ScanTracker:
        """The model in a stream of scans, one after the other; a model of whole scans overrides it."""
        return PairTracker(self.stepper())


NEEDED = ("name", "Options", "estimate")
"""Attributes that every model must have."""
NEEDED_IN_A_STREAM = ("stepper", "tracker")
"""Every model must define at least one of these."""
NEEDED_TO_TRAIN = ("forward", "loss")
"""Attributes that a model must have if it can be trained."""
RECIPE = {"epochs", "learning_rate", "window", "batch_size"}
"""Options of every training, see :class:`rcnn_odom.models.trained.Recipe`."""


def check_model(name: str, model: Any) -> None:
    """Checks that a class is a model.

    Args:
        name: the name under which it is registered.
        model: the class.

    Raises:
        InputError: a part of the interface is missing; the message says which.
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
        problem = f"is not a subclass of {Model.__name__}"
    elif not is_dataclass(model.Options):
        problem = "has Options that are no dataclass"
    elif model.name != name:
        problem = f"its class is named {model.name}; both must be the same"
    else:
        return
    raise InputError(f"model {name}: {problem}; docs/extending.md describes what a model needs")


def all_models(only: str | None = None) -> dict[str, type[Model]]:
    """All models by their names; imports all of them, including torch.

    Args:
        only: of the models of other packages, import only the one with this name; None: import all.

    Raises:
        InputError: two models have the same name, or a part of the interface is missing.
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
    """The model with this name.

    Raises:
        InputError: there is no such model, or as in :func:`all_models`.

    Example:
        >>> find_model("matcher").__name__
        'Matcher'
    """
    found: type[Model] = choose("model", name, all_models(only=name))
    return found
