"""What the commands' arguments have in common."""

import argparse
from collections.abc import Callable, Sequence
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


def join_heights(arguments: Sequence[str]) -> list[str]:
    """``--height -0.1:0.1`` as ``--height=-0.1:0.1``: argparse takes the former's value for an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] == "--height":
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined
