"""Parsers of argument values that several commands use."""

import argparse
import math
import re
from collections.abc import Callable, Sequence
from itertools import takewhile
from pathlib import Path
from typing import TypeAlias

Subcommands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""Type of the object that a command adds its parser to."""


def metres(text: str) -> float:
    """Parses a length above 0, for ``type=`` of an argument.

    Raises:
        argparse.ArgumentTypeError: the text is something else.
    """
    try:
        length = float(text)
    except ValueError:
        length = 0.0
    if not 0 < length < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of metres above 0")
    return length


def whole_number(least: int) -> Callable[[str], int]:
    """Makes a parser of whole numbers of at least ``least``, for ``type=`` of an argument."""

    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, {least} or more")
        return int(text)

    return parse


def height(text: str) -> tuple[float, float]:
    """Parses two heights in metres, for instance ``-0.1:0.1``, for ``type=`` of an argument.

    Raises:
        argparse.ArgumentTypeError: the text is something else, or the first height is not the lower one.
    """
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        low = high = 0.0
    if not -float("inf") < low < high < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not two heights in metres, the lower first: -0.1:0.1")
    return low, high


def degrees(text: str) -> float:
    """Parses an angle in degrees, above 0 and at most 360, for ``type=`` of an argument.

    Raises:
        argparse.ArgumentTypeError: the text is something else.
    """
    try:
        angle = float(text)
    except ValueError:
        angle = 0.0
    if not 0 < angle <= 360:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of degrees above 0, 360 at most")
    return angle


def laser_pose(text: str) -> tuple[float, float, float]:
    """Parses a pose, ``0.2 0 -90`` in metres, metres and degrees, for ``type=`` of an argument.

    Returns:
        x and y in metres, and the heading in radians.

    Raises:
        argparse.ArgumentTypeError: the text is something else.
    """
    try:
        x, y, heading = map(float, text.split())
    except ValueError:
        x = y = heading = math.nan
    if not all(map(math.isfinite, (x, y, heading))):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not three numbers, metres, metres and degrees: 0.2 0 -90"
        )
    return x, y, math.radians(heading)


def split_thinning(text: str) -> tuple[Path, int | None]:
    """Splits ``PATH[::3]``, every third scan of a recording, into the path and the number 3.

    The number is None if the text has no such ending, or if it is the name of an existing file.
    """
    match = re.fullmatch(r"(.+)\[::([1-9]\d*)\]", text)
    if match is None or Path(text).exists():
        return Path(text), None
    return Path(match[1]), int(match[2])


SIGNED = {"--height": 1, "--laser-pose": 3}
"""Options whose values may start with a minus sign, and the number of their values."""


def join_signed(arguments: Sequence[str]) -> list[str]:
    """Joins options with their values if these may start with "-", which argparse would read as options.

    ``--height -0.1:0.1`` becomes ``--height=-0.1:0.1``.
    """
    joined, rest = list[str](), list(arguments)
    while rest:
        joined.append(rest.pop(0))
        values = rest[: SIGNED.get(joined[-1], 0)]
        if joined[-1] == "--laser-pose":
            values = list(takewhile(_is_number, values))
        if values:
            joined[-1] += f"={' '.join(values)}"
            del rest[: len(values)]
    return joined


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
