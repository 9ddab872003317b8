"""What the commands' arguments have in common."""

import argparse
from collections.abc import Callable
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
