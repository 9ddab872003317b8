"""Finds models, recording formats and metrics by their name, those of other packages too.

A package adds its own by Python's entry points, in its ``pyproject.toml``::

    [project.entry-points."rcnn_odom.models"]
    my_model = "my_package.my_model:MyModel"

See docs/extending.md.
"""

from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

from rcnn_odom.errors import InputError


def modules_in(package: str, last: tuple[str, ...] = ()) -> Iterator[ModuleType]:
    """Imports the modules of a package, one after the other by name, some of them after the others."""
    names = {module.name for module in iter_modules(import_module(package).__path__)}
    for name in (*sorted(names - set(last)), *last):
        yield import_module(f"{package}.{name}")


def collect(
    what: str, built_in: Mapping[str, Any], check: Callable[[str, Any], None], only: str | None = None
) -> dict[str, Any]:
    """Everything of one kind by its name: the project's own, and those that entry points add.

    Args:
        what: the kind, ``model``, ``recording format`` or ``metric``; its entry points are in the group
            ``rcnn_odom.models``, ``rcnn_odom.recording_formats`` or ``rcnn_odom.metrics``.
        built_in: the project's own.
        check: raises InputError where one that was added lacks a part.
        only: of those that were added import the one of this name alone; the others are None.

    Raises:
        InputError: two have the same name, or one cannot be imported or lacks a part.
    """
    found = dict(built_in)
    for entry in entry_points(group=f"rcnn_odom.{what.replace(' ', '_')}s"):
        if entry.name in found:
            raise InputError(
                f"two {what}s are called {entry.name}, one of them {entry.value}; rename it in the entry "
                "points of its package"
            )
        found[entry.name] = None
        if only in (None, entry.name):  # what is broken in one package does not stop who asks for another
            found[entry.name] = _load(what, entry)
            check(entry.name, found[entry.name])
    return found


def _load(what: str, entry: EntryPoint) -> Any:
    try:
        return entry.load()
    except Exception as error:  # whatever the code of a stranger's package does
        raise InputError(
            f"{what} {entry.name}: {entry.value} cannot be imported ({type(error).__name__}: {error}); "
            "correct or uninstall its package"
        ) from error


def choose(what: str, name: str, among: Mapping[str, Any]) -> Any:
    """The one of this name.

    Raises:
        InputError: there is none.
    """
    if name not in among:
        raise InputError(f"no {what} is called {name}; there are {', '.join(sorted(among))}")
    return among[name]
