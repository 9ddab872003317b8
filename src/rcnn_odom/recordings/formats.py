"""One interface for all formats of recordings, also those of other packages.

A format is a module. A format for training has ``load(name, **options) -> Recording``. A format for streaming
has ``recognises(path) -> bool`` and ``stream(path, **options) -> ScanStream``.
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
TRIED_LAST = ("carmen", "simulated")
"""``carmen`` recognises any file; ``simulated`` cannot stream and takes a second to import."""

ROBOT_OPTIONS = ("base", "odom_topic")
"""Options that change the poses; it is an error to give them for a format that does not have them."""


def all_formats(only: str | None = None) -> dict[str, ModuleType]:
    """Import all formats.

    Args:
        only: name of the only format to import from other packages; None: import all of them.

    Returns:
        The formats by their names.

    Raises:
        InputError: a format of another package has a name that is taken, or lacks a function.

    >>> sorted(all_formats())[:3]
    ['carmen', 'json_lines', 'kitti']
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
    """Find the format of this name; it must be one for training.

    Raises:
        InputError: there is no such format, or it has no ``load``.
    """
    found: ModuleType = choose(WHAT, name, all_formats(only=name))
    if not hasattr(found, "load"):
        raise InputError(
            f"recording format {name} has no load, so it can only stream; choose another data.reader.format"
        )
    return found


def open_recording(reader: Mapping[str, Any]) -> OpenRecording:
    """Make a function that opens a recording by its name.

    Args:
        reader: ``format``, and the options of its ``load``.

    Raises:
        InputError: there is no such format, or an option of its ``load`` is missing or unknown.

    >>> open_recording({"format": "simulated", "frames": 2})("any name").poses.shape
    (2, 4, 4)
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
    """Open a recording for streaming; its format is found from its content.

    Args:
        path: a KITTI folder, a ROS bag, a CARMEN log, a file of JSON lines, or a recording in a format of
            another package.
        options: ``topic`` of a bag or of rosbridge's messages, ``ring`` of a KITTI drive or of a point cloud,
            ``height`` of a point cloud, ``odom_topic``, ``base`` and ``laser_pose`` of a bag's robot,
            ``field_of_view_deg`` of a CARMEN log's FLASER lines. Options that are None are ignored. An option
            that the format does not have is ignored with a warning; one that changes the poses
            (``ROBOT_OPTIONS``) is an error.

    Raises:
        InputError: the path is no recording, it cannot be read, or an option does not fit its format.
    """
    if not path.exists():
        raise InputError(
            f"{path}: no such file or folder; give a KITTI drive, a CARMEN log, a ROS bag or JSON lines"
        )
    if not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: is a pipe or device; give a file, or --live for JSON lines")
    for found in chain(collect(WHAT, {}, _check).values(), modules_in(PACKAGE, TRIED_LAST)):
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
    """The options that a format's ``stream`` takes.

    Raises:
        InputError: an option that changes the poses is not among them.
    """
    given = {name: value for name, value in options.items() if value is not None}
    taken = signature(found.stream).parameters
    for name in sorted(given.keys() - taken.keys()):
        kind = found.__name__.rpartition(".")[2]
        if name in ROBOT_OPTIONS:
            raise InputError(f"{path}: read as {kind}, which has no option {name}; leave it out")
        log.warning("%s: read as %s, which has no option %s; the option is ignored", path, kind, name)
    return {name: value for name, value in given.items() if name in taken}
