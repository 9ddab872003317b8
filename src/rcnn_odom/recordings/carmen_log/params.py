"""Finds the parameters of a CARMEN log's front laser in the PARAM lines; FLASER lines do not hold them."""

import contextlib
import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.carmen_log.front_laser import (
    CIRCLE,
    PRINTED,
    FrontLaser,
    agree,
    even_spacing,
    rounding_of,
)
from rcnn_odom.recordings.text import lines_of

NAME = re.compile(r"front_?laser_(fov|resolution|max)$")
"""laser_front_laser_fov (radians), laser_frontlaser_resolution (degrees), robot_front_laser_max (metres)."""
OPTION = "data.field_of_view_deg=..., with rcnn-odom run: --field-of-view-deg"
IN_RADIANS = ": is it in radians, not degrees?"
DEFAULT_DEG = 180.0
"""Field of view of the lasers of most logs; used if the log does not say it."""
MOST_BEYOND = 0.03
"""Largest part of the readings beyond a maximum range that is used."""
SAME_CODE = 0.01
"""Beyond the maximum, readings within this part of the most frequent one are the same code for no return."""
ONE_READING = 0.001
"""Readings that differ by less than this part count as equal, which limits the memory for a long log."""
COARSEST_RADIANS = 0.1
"""Radians; largest angle between neighbouring beams of a planar laser."""
MAX_SHOWN = 40
"""Characters that a message shows of a word that is not a number."""


class Parameter(NamedTuple):
    """One PARAM line.

    Attributes:
        name: name of the parameter.
        value: its number; nan if the word is not a number.
        word: the number as it is written.
    """

    name: str
    value: float
    word: str

    def __str__(self) -> str:
        return f"PARAM {self.name} {self.word}"


Parameters = dict[str, list[Parameter]]


class FoundLaser(NamedTuple):
    """The front laser of a log.

    Attributes:
        laser: its parameters.
        notes: where the parameters come from, unless they are the defaults.
        warnings: parameters of the log that are not used: they are not numbers, or contradict an option.
    """

    laser: FrontLaser
    notes: list[str]
    warnings: list[str]


def check_field_of_view(field_of_view_deg: float | None) -> None:
    """Check the field of view that a user gave.

    Raises:
        InputError: it is not above 0 and at most 360 degrees.
    """
    if field_of_view_deg is not None and not 0 < field_of_view_deg <= 360:
        raise InputError(
            f"the field of view is {field_of_view_deg} degrees; set it above 0 and at most 360 ({OPTION})"
        )


def find_front_laser(path: Path, field_of_view_deg: float | None) -> FoundLaser:
    """Find the parameters of the laser of FLASER lines: from the option, else from the log, else the default.

    Args:
        path: path of the log, which is read as far as possible.
        field_of_view_deg: degrees, given by the user; None: take it from the log.

    Raises:
        InputError: parameters of the log contradict each other, and no field of view was given.
    """
    parameters, counts, unusable = _read_parameters(path)
    if not counts:
        given = field_of_view_deg is not None
        notes = ["field_of_view_deg is not used: the log has no FLASER lines"] if given else []
        return FoundLaser(FrontLaser(), notes, [])
    [(count, _)] = counts.most_common(1)
    if field_of_view_deg is None:
        _need_agreement(path, parameters, count)
    degrees, notes, contradiction = _choose_field_of_view(parameters, count, field_of_view_deg)
    maximum, maximum_notes = _find_maximum(path, parameters["max"])
    laser = FrontLaser(math.radians(degrees), maximum=maximum)
    for resolution in parameters["resolution"][-1:]:
        rounding = rounding_of(resolution.word)
        if not contradiction and agree(degrees, resolution.value, count, rounding):
            rounding = math.inf if field_of_view_deg is not None else math.radians(rounding)
            laser = laser._replace(resolution=math.radians(resolution.value), rounding=rounding)
    return FoundLaser(laser, notes + maximum_notes, unusable + ([contradiction] if contradiction else []))


def _read_parameters(path: Path) -> tuple[Parameters, Counter[int], list[str]]:
    """The usable parameters, the number of FLASER lines by their number of readings, and warnings.

    The parameters are grouped into ``fov``, ``resolution`` and ``max``; a warning names each unusable one.
    """
    parameters: Parameters = {"fov": [], "resolution": [], "max": []}
    counts: Counter[int] = Counter()
    unusable: dict[str, None] = {}
    for kind, rest in _split_lines(path):
        first, *more = rest.split(None, 2)
        if kind == "FLASER":
            counts[_parse_count(first)] += 1
        elif kind == "PARAM" and more and (match := NAME.search(first)):
            found = Parameter(first, _parse_number(more[0]), more[0])
            if PRINTED < found.value < math.inf:
                parameters[match[1]].append(found)
            elif found.value != 0:  # 0 means that the parameter was never set
                fault = "not above 0" if math.isfinite(found.value) else "not a number"
                shown = found._replace(word=found.word[:MAX_SHOWN])
                unusable[f"the log's {shown} is {fault}, so it is not used"] = None
    del counts[0]
    return parameters, counts, list(unusable)


def _parse_number(word: str) -> float:
    """The number that a word holds; nan if it is not a number."""
    try:
        return float(word)
    except ValueError:
        return math.nan


def _parse_count(word: str) -> int:
    """The number of readings that a line announces; 0 if the word is not such a number."""
    return int(word) if word.isdecimal() and len(word) < 9 else 0


def _split_lines(path: Path) -> Iterator[tuple[str, str]]:
    """First word and rest of each FLASER and PARAM line, up to where the file can be read."""
    # The reader of the scans reports where the file is cut off.
    with contextlib.suppress(InputError):
        for _, text in lines_of(path):
            kind, *rest = text.split(None, 1)[:2] or [""]
            if rest and kind in ("FLASER", "PARAM"):
                yield kind, rest[0]


def _need_agreement(path: Path, parameters: Parameters, count: int) -> None:
    """Check that the parameters do not contradict each other or the number of readings.

    Raises:
        InputError: they do.
    """
    for group in (parameters["fov"], parameters["resolution"]):
        ordered = sorted(group, key=lambda parameter: parameter.value)
        if ordered and ordered[-1].value > 1.001 * ordered[0].value:  # more than a rounding difference
            both = f"{ordered[0]} and {ordered[-1]}"
            raise InputError(f"{path}: says {both}; set the right field of view ({OPTION})")
    for fov in parameters["fov"][-1:]:
        if fov.value > CIRCLE:
            raise InputError(
                f"{path}: {fov} is more than 2 pi: is it in degrees, not radians?; set the field of view "
                f"({OPTION})"
            )
        for resolution in parameters["resolution"][-1:]:
            degrees, rounding = math.degrees(fov.value), rounding_of(resolution.word)
            if not agree(degrees, resolution.value, count, rounding):
                in_radians = agree(fov.value, resolution.value, count, rounding)
                raise InputError(
                    f"{path}: {fov} ({degrees:.4g} degrees) and {resolution} (degrees) do not fit {count} "
                    f"readings, which cover {resolution.value * (count - 1):.4g} degrees at that resolution"
                    f"{IN_RADIANS if in_radians else ''}; set the right field of view ({OPTION})"
                )
    if not parameters["fov"]:
        _need_degrees(path, parameters["resolution"][-1:], count)


def _need_degrees(path: Path, resolutions: list[Parameter], count: int) -> None:
    """Check that a resolution is not in radians by mistake.

    Raises:
        InputError: taken as degrees, the resolution gives so small a field of view that radians fit better.
    """
    for resolution in resolutions:
        covered = _covered_deg(resolution.value, count)
        if resolution.value < COARSEST_RADIANS and covered < CIRCLE:
            raise InputError(
                f"{path}: at {resolution} (degrees) its {count} readings cover {covered:.4g} degrees"
                f"{IN_RADIANS}; set the field of view ({OPTION})"
            )


def _read_field_of_view(parameters: Parameters, count: int) -> tuple[float, Parameter] | None:
    """Degrees that the beams cover by the log, and the parameter that says so; None if no parameter does."""
    for fov in reversed(parameters["fov"]):
        # Above 2 pi it can only be degrees. Without the option, _need_agreement has refused it already.
        return fov.value if fov.value > CIRCLE else math.degrees(fov.value), fov
    for resolution in reversed(parameters["resolution"]):
        return _covered_deg(resolution.value, count), resolution
    return None


def _choose_field_of_view(
    parameters: Parameters, count: int, given: float | None
) -> tuple[float, list[str], str]:
    """Degrees that the beams cover, notes on their source, and a contradiction between option and log."""
    logged, source = _read_field_of_view(parameters, count) or (DEFAULT_DEG, None)
    if given is not None:
        contradicts = source and logged <= 360 and abs(logged - given) > even_spacing(logged, count)
        contradiction = f"the log's {source} says {logged:.4g} degrees, but {given:g} were given"
        return given, [f"field of view: {given:g} degrees, as given"], contradiction if contradicts else ""
    if source is None:
        return DEFAULT_DEG, [], ""
    if logged > 360:
        note = f"the log's {source} (degrees) does not fit {count} readings"
        return DEFAULT_DEG, [f"{note}; field of view: {DEFAULT_DEG:g} degrees, the default"], ""
    return logged, [f"field of view: {logged:.4g} degrees by the log's {source}"], ""


def _covered_deg(resolution: float, count: int) -> float:
    """Degrees that ``count`` beams cover at a resolution; the inverse of :func:`even_spacing`."""
    closed = resolution * (count - 1) if count > 1 else resolution
    covered = resolution / even_spacing(1.0, count)
    return covered if covered <= 360 else closed


def _find_maximum(path: Path, parameters: list[Parameter]) -> tuple[float, list[str]]:
    """The log's maximum range in metres, infinite if too many readings lie beyond it; and a note about it."""
    if not parameters:
        return math.inf, []
    largest = max(parameters, key=lambda parameter: parameter.value)
    positive, beyond = _count_beyond(path, largest.value)
    if not beyond:
        return largest.value, []
    [(code, _)] = beyond.most_common(1)
    others = sum(beyond[size] for size in beyond if abs(size - code) * ONE_READING > SAME_CODE)
    if others / positive > MOST_BEYOND:
        share = f"{others / positive:.0%} of the readings"
        return math.inf, [f"the log's {largest} is not used: {share} lie beyond it"]
    return largest.value, [f"{beyond.total()} readings at the log's {largest} m or beyond are no returns"]


def _count_beyond(path: Path, maximum: float) -> tuple[int, Counter[int]]:
    """Number of positive readings, and numbers of readings at or beyond the maximum, by size.

    A size is the logarithm of a reading, rounded in steps of ``ONE_READING``.
    """
    positive, beyond = 0, Counter[int]()
    for kind, rest in _split_lines(path):
        if kind != "FLASER":
            continue
        words = rest.split()
        try:
            readings = np.array(words[1 : 1 + _parse_count(words[0])], dtype=np.float64)
        except ValueError:
            continue  # a broken line, which the reader of the scans reports
        readings = readings[(readings > 0) & np.isfinite(readings)]
        positive += len(readings)
        sizes = np.round(np.log(readings[readings >= maximum]) / ONE_READING).astype(int)
        beyond.update(sizes.tolist())
    return positive, beyond
