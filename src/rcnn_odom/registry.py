"""Finds models, recording formats and metrics by name, including those of other packages.

Another package registers its own by Python's entry points, in its ``pyproject.toml``::

    [project.entry-points."rcnn_odom.models"]
    my_model = "my_package.my_model:MyModel"

See docs/extending.md.
"""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

from rcnn_odom.errors import InputError


def modules_in(package: str, last: tuple[str, ...] = ()) -> Iterator[ModuleType]:
    """Imports the modules of a package one after the other, in the order of their names.

    Args:
        package: full name of the package.
        last: names of modules that are imported after all the others, in this order.

    Example:
        >>> [module.__name__ for module in modules_in("email.mime", last=("application",))][-2:]
        ['email.mime.text', 'email.mime.application']
    """
    names = {module.name for module in iter_modules(import_module(package).__path__)}
    for name in (*sorted(names - set(last)), *last):
        yield import_module(f"{package}.{name}")


def collect(
    kind: str, built_in: Mapping[str, Any], check: Callable[[str, Any], None], only: str | None = None
) -> dict[str, Any]:
    """All models, all recording formats or all metrics by name: built-in ones and those of entry points.

    Args:
        kind: ``model``, ``recording format`` or ``metric``. The group of its entry points is
            ``rcnn_odom.models``, ``rcnn_odom.recording_formats`` or ``rcnn_odom.metrics``.
        built_in: those of this project.
        check: gets the name and the object of an entry point; raises InputError if the object lacks a part.
        only: import only the entry point of this name; the values of the other entry points are None.

    Raises:
        InputError: two have the same name, or one cannot be imported or lacks a part.

    Example:
        >>> collect("metric", {"drift": "the built-in one"}, check=print, only="drift")["drift"]
        'the built-in one'
    """
    found = dict(built_in)
    for entry in entries_of(f"rcnn_odom.{kind.replace(' ', '_')}s"):
        if entry.name in found:
            raise InputError(
                f"two {kind}s are called {entry.name}, one of them {entry.value}; rename it in the entry "
                "points of its package"
            )
        found[entry.name] = None
        if only in (None, entry.name):  # A broken package must not stop a user who asks for another one.
            found[entry.name] = _load(kind, entry)
            check(entry.name, found[entry.name])
    return found


def entries_of(group: str) -> Iterable[EntryPoint]:
    """The entry points of a group, of all installed packages.

    Example:
        >>> [entry.name for entry in entries_of("console_scripts") if entry.name == "rcnn-odom"]
        ['rcnn-odom']
    """
    return _read_entries(group, tuple((folder, _changed(Path(folder))) for folder in sys.path))


def _changed(folder: Path) -> int | None:
    """When a folder has changed, as by the installation of a package; None without such a folder."""
    try:
        return folder.stat().st_mtime_ns
    except OSError:
        return None


@lru_cache(maxsize=64)
def _read_entries(group: str, search_path: tuple[tuple[str, int | None], ...]) -> tuple[EntryPoint, ...]:
    """Reads the entry points of all packages; cached, since a run asks for the metrics some fifty times."""
    return tuple(entry_points(group=group))


def _load(kind: str, entry: EntryPoint) -> Any:
    try:
        return entry.load()
    except Exception as error:  # The code of another package may raise anything.
        raise InputError(
            f"{kind} {entry.name}: {entry.value} cannot be imported ({type(error).__name__}: {error}); "
            "correct or uninstall its package"
        ) from error


def choose(kind: str, name: str, among: Mapping[str, Any]) -> Any:
    """Returns the entry of this name.

    Args:
        kind: of the entries, for the error message.
        name: the wanted one.
        among: all entries by name.

    Raises:
        InputError: there is no such entry.

    Example:
        >>> choose("model", "matcher", {"matcher": 1, "cnn_reg": 2})
        1
        >>> choose("model", "resnet", {"matcher": 1, "cnn_reg": 2})
        Traceback (most recent call last):
            ...
        rcnn_odom.errors.InputError: no model is called resnet; there are cnn_reg, matcher
    """
    if name not in among:
        raise InputError(f"no {kind} is called {name}; there are {', '.join(sorted(among))}")
    return among[name]
