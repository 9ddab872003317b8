"""One interface for all formats of recordings, those of other packages too.

A format is a module. ``load(name, **options) -> Recording`` makes it one to train on; ``recognises(path) ->
bool`` and ``stream(path, **options) -> ScanStream`` make it one to stream.
"""

from collections.abc import Mapping
from functools import partial
from inspect import signature
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.recording import OpenRecording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.registry import choose, collect, modules_in

WHAT, PACKAGE = "recording format", "rcnn_odom.recordings"
ASKED_LAST = ("carmen", "simulated")
"""One knows any file; the other streams nothing and takes a second to be imported."""


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
        options: ``topic`` of a bag's LaserScan, ``ring`` of a KITTI sequence, ``field_of_view_deg`` of a
            CARMEN log's FLASER lines; each format takes its own, and None is left out.

    Raises:
        InputError: nothing of the kind, or it cannot be read.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give a KITTI sequence, a CARMEN log or a ROS bag")
    for found in chain(collect(WHAT, {}, _check).values(), modules_in(PACKAGE, ASKED_LAST)):
        if hasattr(found, "recognises") and found.recognises(path):
            taken = signature(found.stream).parameters
            given = {name: value for name, value in (options or {}).items() if value is not None}
            stream: ScanStream = found.stream(path, **{name: given[name] for name in given if name in taken})
            return stream
    raise InputError(
        f"{path}: neither a KITTI sequence (no velodyne/ in it; name sequences/05) nor a ROS 2 bag (no "
        "metadata.yaml)"
    )


class Spacing(Protocol):
    """The laser for which a network was trained."""

    @property
    def field_of_view_deg(self) -> float:
        """Degrees that it covers."""

    @property
    def resolution_deg(self) -> float:
        """Degrees between the bins."""


def need_fitting_scan(stream: ScanStream, scan: Scan, sensor: Spacing) -> None:
    """Compares the beams of a scan with what a network was trained for; returns alone do not tell of them.

    Raises:
        InputError: they cover another part of the circle, or are too far apart or too close for its bins.
    """
    beams = stream.beams
    if beams is None and scan.has_all_beams:
        beams = _beams_of(scan, sensor)
    if beams is None:
        return
    covered, spacing = beams
    fits = abs(covered - sensor.field_of_view_deg) <= 0.1 * sensor.field_of_view_deg
    # From a third of a bin on, as 0.5 degrees for 1, to two bins, as a Velodyne's 0.18 for 0.1.
    if not (fits and 0.3 * sensor.resolution_deg < spacing < 2.05 * sensor.resolution_deg):
        raise InputError(
            f"{stream.name}: a laser of {covered:.0f} degrees, a beam every {spacing:.2g}, but the model is "
            f"for {sensor.field_of_view_deg:g} degrees with one every {sensor.resolution_deg:g}; train one "
            "for such a laser (python train.py data.sensor.field_of_view_deg=... "
            "data.sensor.resolution_deg=...)"
        )


def _beams_of(scan: Scan, sensor: Spacing) -> tuple[float, float]:
    """Degrees that the beams cover, and degrees between them; without bearings they cover the sensor's."""
    count = len(scan.ranges)
    if scan.bearings is None:
        return sensor.field_of_view_deg, sensor.field_of_view_deg / max(count - 1, 1)
    spacing = float(np.rad2deg(np.median(np.abs(np.diff(scan.bearings))))) if count > 1 else 360.0
    return spacing * count, spacing
