"""One interface for all formats of recordings, those of other packages too.

A format is a module. ``load(name, **options) -> Recording`` makes it one to train on; ``recognises(path) ->
bool`` and ``stream(path, **options) -> ScanStream`` make it one to stream.
"""

import logging
from collections.abc import Mapping
from functools import partial
from inspect import signature
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.recording import OpenRecording
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.registry import choose, collect, modules_in

log = logging.getLogger(__name__)

WHAT, PACKAGE = "recording format", "rcnn_odom.recordings"
ASKED_LAST = ("carmen", "simulated")
"""One knows any file; the other streams nothing and takes a second to be imported."""

OF_THE_ROBOT = ("base", "odom_topic")
"""Options of a ``stream`` without which the poses would be others: refused where a format has none."""


def all_formats(only: str | None = None) -> dict[str, ModuleType]:
    """The formats by their names; imports all of them.

    Args:
        only: of those of other packages import the one of this name alone.

    Raises:
        InputError: one that another package adds has the name of another, or lacks a part.
    """
    modules = {module.__name__.rpartition(".")[2]: module for module in modules_in(PACKAGE)}
    own = {name: module for name, module in modules.items() if {"load", "recognises"} & set(dir(module))}
    return collect(WHAT, own, _check, only)


def _check(name: str, module: Any) -> None:
    missing = [part for part in ("recognises", "stream") if not callable(getattr(module, part, None))]
    if missing == ["recognises", "stream"] and callable(getattr(module, "load", None)):
        return
    if missing:
        raise InputError(
            f"recording format {name} has no {' and no '.join(missing)}; it needs load, or recognises and "
            "stream, or all three"
        )


def find_format(name: str) -> ModuleType:
    """The format of this name, one to train on.

    Raises:
        InputError: there is none, or it has no ``load``.
    """
    found: ModuleType = choose(WHAT, name, all_formats(only=name))
    if not hasattr(found, "load"):
        raise InputError(
            f"recording format {name} has no load, so that it only streams; choose another data.reader.format"
        )
    return found


def open_recording(reader: Mapping[str, Any]) -> OpenRecording:
    """What opens recordings by their names.

    Args:
        reader: ``format``, and the options of its ``load``.

    Raises:
        InputError: there is no such format, or it lacks an option or does not take one.
    """
    options = dict(reader)
    name = options.pop("format", None)
    load = find_format(name).load
    try:
        signature(load).bind("any name", **options)
    except TypeError as error:
        raise InputError(
            f"data.reader: {error}; {name} has {', '.join(signature(load).parameters)}"
        ) from error
    return partial(load, **options)


def open_stream(path: Path, options: Mapping[str, Any] | None = None) -> ScanStream:
    """A recording by what it looks like: KITTI folder, ROS bag, CARMEN log or one of another package.

    Args:
        path: of it.
        options: ``topic`` of a bag or of rosbridge's messages, ``ring`` of a KITTI drive or of a point cloud,
            ``height`` of a point cloud, ``odom_topic``, ``base`` and ``laser_pose`` of a bag's robot,
            ``field_of_view_deg`` of a CARMEN log's FLASER lines. None is left out; one that the format does
            not have is told and left out, or refused where the poses would be others.

    Raises:
        InputError: nothing of the kind, or it cannot be read.
    """
    if not path.exists():
        raise InputError(
            f"{path}: no such file or folder; give a KITTI drive, a CARMEN log, a ROS bag or JSON lines"
        )
    if not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: is a pipe or device; give a file, or --live for JSON lines")
    for found in chain(collect(WHAT, {}, _check).values(), modules_in(PACKAGE, ASKED_LAST)):
        if hasattr(found, "recognises") and found.recognises(path):
            stream: ScanStream = found.stream(path, **_options_for(found, path, options or {}))
            return stream
    bags = sorted(file.name for file in path.iterdir() if file.suffix.lower() == ".bag")
    if bags:
        raise InputError(f"{path}: a folder of ROS 1 bags; give one of the bags in it: {', '.join(bags)}")
    raise InputError(
        f"{path}: neither a KITTI sequence (no velodyne/ or velodyne_points/ in it; name sequences/05) nor a "
        "ROS 2 bag (no metadata.yaml, .db3 or .mcap in it); give one of them"
    )


def _options_for(found: ModuleType, path: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the options that a format's ``stream`` takes."""
    given = {name: value for name, value in options.items() if value is not None}
    taken = signature(found.stream).parameters
    for name in sorted(given.keys() - taken.keys()):
        kind = found.__name__.rpartition(".")[2]
        if name in OF_THE_ROBOT:
            raise InputError(f"{path}: read as {kind}, which has no option {name}; leave it out")
        log.warning("%s: read as %s, which has no option %s; it is left out", path, kind, name)
    return {name: value for name, value in given.items() if name in taken}
