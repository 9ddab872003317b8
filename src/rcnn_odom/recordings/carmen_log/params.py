"""What the PARAM lines of a CARMEN log say of the front laser, whose FLASER lines say too little of it."""

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
"""As in laser_front_laser_fov (radians), laser_frontlaser_resolution (degrees), robot_front_laser_max (m)."""
OPTION = "data.field_of_view_deg=..., of rcnn-odom run: --field-of-view-deg"
IN_RADIANS = ": is it in radians, not degrees?"
USUAL_DEG = 180.0
"""Of the lasers of most logs, where nothing else is known."""
MOST_BEYOND = 0.03
"""Part of the readings that may lie beyond a maximum that is believed."""
SAME_CODE = 0.01
"""Readings this close to the most frequent one beyond the maximum are the same code for no return."""
ONE_READING = 0.001
"""Part of a reading: what differs by less is counted as one, so that a long log needs no more memory."""
COARSEST_RADIANS = 0.1
"""No planar laser's beams lie farther apart."""
SHOWN = 40
"""Characters of a word that is no number."""


class Parameter(NamedTuple):
    """One PARAM line: its name, its number, and that as it is written."""

    name: str
    value: float
    word: str

    def __str__(self) -> str:
        return f"PARAM {self.name} {self.word}"


Parameters = dict[str, list[Parameter]]


class FoundLaser(NamedTuple):
    """The front laser of a log.

    Attributes:
        laser: itself.
        notes: where this is known from, where that is not a matter of course.
        warnings: of what the log says and is not used: it is no number, or an option stands before it.
    """

    laser: FrontLaser
    notes: list[str]
    warnings: list[str]


def check_field_of_view(field_of_view_deg: float | None) -> None:
    """Raises InputError where an option is no field of view."""
    if field_of_view_deg is not None and not 0 < field_of_view_deg <= 360:
        raise InputError(
            f"a field_of_view_deg of {field_of_view_deg}; set it above 0 and at most 360 ({OPTION})"
        )


def find_front_laser(path: Path, field_of_view_deg: float | None) -> FoundLaser:
    """The laser of a log's FLASER lines: an option stands before the log, and the log before the usual.

    Args:
        path: of the log, which is read as far as it can be.
        field_of_view_deg: given by the user; None: as the log says.

    Raises:
        InputError: what the log says contradicts itself, and no option settles it.
    """
    parameters, counts, unusable = _survey(path)
    if not counts:
        given = field_of_view_deg is not None
        notes = ["field_of_view_deg is of FLASER lines: not used"] if given else []
        return FoundLaser(FrontLaser(), notes, [])
    [(count, _)] = counts.most_common(1)
    if field_of_view_deg is None:
        _need_agreement(path, parameters, count)
    degrees, notes, contradiction = _choose_field_of_view(parameters, count, field_of_view_deg)
    maximum, about_maximum = _believed_maximum(path, parameters["max"])
    laser = FrontLaser(math.radians(degrees), maximum=maximum)
    for said in parameters["resolution"][-1:]:
        rounding = rounding_of(said.word)
        if not contradiction and agree(degrees, said.value, count, rounding):
            rounding = math.inf if field_of_view_deg is not None else math.radians(rounding)
            laser = laser._replace(resolution=math.radians(said.value), rounding=rounding)
    return FoundLaser(laser, notes + about_maximum, unusable + ([contradiction] if contradiction else []))


def _survey(path: Path) -> tuple[Parameters, Counter[int], list[str]]:
    """The parameters by what they say, how many FLASER lines there are of each number of readings, and
    words on the parameters that say nothing.
    """
    parameters: Parameters = {"fov": [], "resolution": [], "max": []}
    counts: Counter[int] = Counter()
    unusable: dict[str, None] = {}
    for kind, rest in _head_of_lines(path):
        first, *more = rest.split(None, 2)
        if kind == "FLASER":
            counts[_count(first)] += 1
        elif kind == "PARAM" and more and (match := NAME.search(first)):
            said = Parameter(first, _number(more[0]), more[0])
            if PRINTED < said.value < math.inf:
                parameters[match[1]].append(said)
            elif said.value != 0:  # as where nobody has set it
                fault = "not above 0" if math.isfinite(said.value) else "no number"
                unusable[f"the log's {said._replace(word=said.word[:SHOWN])} is {fault}, not used"] = None
    del counts[0]
    return parameters, counts, list(unusable)


def _number(word: str) -> float:
    """What a word says, nan where it is none."""
    try:
        return float(word)
    except ValueError:
        return math.nan


def _count(word: str) -> int:
    """The number of readings that a line announces, 0 where it is broken."""
    return int(word) if word.isdecimal() and len(word) < 9 else 0


def _head_of_lines(path: Path) -> Iterator[tuple[str, str]]:
    """First word and all others of FLASER and PARAM lines, up to where the file breaks off."""
    # Where it breaks off is told by whoever reads its scans.
    with contextlib.suppress(InputError):
        for _, text in lines_of(path):
            kind, *rest = text.split(None, 1)[:2] or [""]
            if rest and kind in ("FLASER", "PARAM"):
                yield kind, rest[0]


def _need_agreement(path: Path, parameters: Parameters, count: int) -> None:
    """Refuses parameters that contradict each other or the number of readings.

    Raises:
        InputError: they do.
    """
    for said in (parameters["fov"], parameters["resolution"]):
        ordered = sorted(said, key=lambda parameter: parameter.value)
        if ordered and ordered[-1].value > 1.001 * ordered[0].value:  # more than another rounding
            both = f"{ordered[0]} and {ordered[-1]}"
            raise InputError(f"{path}: says {both}; say which field of view is right ({OPTION})")
    for fov in parameters["fov"][-1:]:
        if fov.value > CIRCLE:
            raise InputError(
                f"{path}: {fov} is more than 2 pi: is it in degrees, not radians?; say the field of view "
                f"({OPTION})"
            )
        for resolution in parameters["resolution"][-1:]:
            degrees, rounding = math.degrees(fov.value), rounding_of(resolution.word)
            if not agree(degrees, resolution.value, count, rounding):
                in_radians = agree(fov.value, resolution.value, count, rounding)
                raise InputError(
                    f"{path}: {fov} ({degrees:.4g} degrees) and {resolution} (degrees) do not fit {count} "
                    f"readings, which cover {resolution.value * (count - 1):.4g} degrees at that resolution"
                    f"{IN_RADIANS if in_radians else ''}; say which field of view is right ({OPTION})"
                )
    if not parameters["fov"]:
        _need_degrees(path, parameters["resolution"][-1:], count)


def _need_degrees(path: Path, resolutions: list[Parameter], count: int) -> None:
    """Refuses a resolution by which the readings cover as many degrees as a laser's may cover radians."""
    for resolution in resolutions:
        covered = _covered(resolution.value, count)
        if resolution.value < COARSEST_RADIANS and covered < CIRCLE:
            raise InputError(
                f"{path}: by {resolution} (degrees) its {count} readings cover {covered:.4g} degrees"
                f"{IN_RADIANS}; say the field of view ({OPTION})"
            )


def _said_field_of_view(parameters: Parameters, count: int) -> tuple[float, Parameter] | None:
    """Degrees that the beams cover as the log says, and the line that says so; None where none does."""
    for fov in reversed(parameters["fov"]):
        # Above 2 pi it can only be degrees; without an option that stands before it, it is refused.
        return fov.value if fov.value > CIRCLE else math.degrees(fov.value), fov
    for resolution in reversed(parameters["resolution"]):
        return _covered(resolution.value, count), resolution
    return None


def _choose_field_of_view(
    parameters: Parameters, count: int, given: float | None
) -> tuple[float, list[str], str]:
    """Degrees that the beams cover, words on where this is from, and on what else the log says."""
    said, source = _said_field_of_view(parameters, count) or (USUAL_DEG, None)
    if given is not None:
        contradicts = source and said <= 360 and abs(said - given) > even_spacing(said, count)
        contradiction = f"the log's {source} says {said:.4g} degrees, but {given:g} were given"
        return given, [f"field of view: {given:g} degrees, as given"], contradiction if contradicts else ""
    if source is None:
        return USUAL_DEG, [], ""
    if said > 360:
        note = f"the log's {source} (degrees) is not that of {count} readings"
        return USUAL_DEG, [f"{note}; field of view: {USUAL_DEG:g} degrees, the usual"], ""
    return said, [f"field of view: {said:.4g} degrees by the log's {source}"], ""


def _covered(resolution: float, count: int) -> float:
    """Degrees that so many beams cover at a resolution; the inverse of :func:`even_spacing`."""
    closed = resolution * (count - 1) if count > 1 else resolution
    covered = resolution / even_spacing(1.0, count)
    return covered if covered <= 360 else closed


def _believed_maximum(path: Path, said: list[Parameter]) -> tuple[float, list[str]]:
    """The maximum range in metres that the log says, unless its readings contradict it; and words on it."""
    if not said:
        return math.inf, []
    largest = max(said, key=lambda parameter: parameter.value)
    positive, beyond = _count_beyond(path, largest.value)
    if not beyond:
        return largest.value, []
    [(code, _)] = beyond.most_common(1)
    others = sum(beyond[size] for size in beyond if abs(size - code) * ONE_READING > SAME_CODE)
    if others / positive > MOST_BEYOND:
        share = f"{others / positive:.0%} of the readings"
        return math.inf, [f"the log's {largest} is not believed: {share} lie beyond it"]
    return largest.value, [f"{beyond.total()} readings at the log's {largest} m or beyond are no returns"]


def _count_beyond(path: Path, maximum: float) -> tuple[int, Counter[int]]:
    """How many readings are positive, and how many from the maximum on, by the size of their logarithm."""
    positive, beyond = 0, Counter[int]()
    for kind, rest in _head_of_lines(path):
        if kind != "FLASER":
            continue
        words = rest.split()
        try:
            readings = np.array(words[1 : 1 + _count(words[0])], dtype=np.float64)
        except ValueError:
            continue  # a broken line, told by whoever reads the scans
        readings = readings[(readings > 0) & np.isfinite(readings)]
        positive += len(readings)
        sizes = np.round(np.log(readings[readings >= maximum]) / ONE_READING).astype(int)
        beyond.update(sizes.tolist())
    return positive, beyond
