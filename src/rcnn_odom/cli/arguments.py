"""What the commands' arguments have in common."""

import argparse
import math
import re
from collections.abc import Callable, Sequence
from itertools import takewhile
from pathlib import Path
from typing import TypeAlias

Subcommands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""What a command adds itself to."""


def metres(text: str) -> float:
    """A length above 0, for ``type=`` of an argument."""
    try:
        length = float(text)
    except ValueError:
        length = 0.0
    if not 0 < length < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of metres above 0")
    return length


def whole_number(least: int) -> Callable[[str], int]:
    """A parser of whole numbers from ``least`` on, for ``type=`` of an argument."""

    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, {least} or more")
        return int(text)

    return parse


def height(text: str) -> tuple[float, float]:
    """Two heights in metres, ``-0.1:0.1``, for ``type=`` of an argument."""
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        low = high = 0.0
    if not -float("inf") < low < high < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not two heights in metres, the lower first: -0.1:0.1")
    return low, high


def degrees(text: str) -> float:
    """An angle above 0 and up to the circle, for ``type=`` of an argument."""
    try:
        angle = float(text)
    except ValueError:
        angle = 0.0
    if not 0 < angle <= 360:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of degrees above 0, 360 at most")
    return angle


def laser_pose(text: str) -> tuple[float, float, float]:
    """Metres, metres and degrees as x, y and heading in radians, for ``type=`` of an argument."""
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
    """The path and the 3 of ``PATH[::3]``; None of a path alone, and where there is a file of that name."""
    match = re.fullmatch(r"(.+)\[::([1-9]\d*)\]", text)
    if match is None or Path(text).exists():
        return Path(text), None
    return Path(match[1]), int(match[2])


SIGNED = {"--height": 1, "--laser-pose": 3}
"""Options whose values may begin with a minus, and how many values they have."""


def join_signed(arguments: Sequence[str]) -> list[str]:
    """``--height -0.1:0.1`` as ``--height=-0.1:0.1``: argparse takes the former's value for an option."""
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
