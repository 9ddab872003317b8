"""The commands that ``rcnn-odom-robot``, the distribution without training, does not have."""

import argparse
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

from rcnn_odom.cli.arguments import Subcommands
from rcnn_odom.errors import InputError


def is_full() -> bool:
    """Whether training is installed, and with it PyTorch, Lightning and Hydra."""
    found = find_spec("rcnn_odom.training")
    # A folder without code is what an uninstalled distribution has left behind.
    return found is not None and found.origin is not None


def need_full(what: str) -> None:
    """Says what to install where something needs all of the project.

    Args:
        what: is wanted, the beginning of the sentence.

    Raises:
        InputError: only the robot's part is installed.
    """
    if not is_full():
        raise InputError(f"{what} needs more than rcnn-odom-robot has: pip install rcnn-odom")


def add_missing(commands: Subcommands, name: str) -> None:
    """Adds a command that only says what to install, whatever its arguments."""
    add_passing_on(commands, name, partial(_refuse, name), "needs more: pip install rcnn-odom")


def _refuse(name: str, _: argparse.Namespace) -> int:
    need_full(f"rcnn-odom {name}")
    raise AssertionError("a command that is there was said to be missing")


def add_passing_on(
    commands: Subcommands, name: str, run: Callable[[argparse.Namespace], int], about: str
) -> None:
    """Adds a command whose ``arguments`` all go on as they are, ``--help`` among them.

    Args:
        commands: of ``rcnn-odom``.
        name: of the command.
        run: gets the arguments; the exit status.
        about: one line of help.
    """
    # No argument begins with this character, so that argparse takes none for an option.
    parser = commands.add_parser(name, help=about, add_help=False, prefix_chars="\0")
    parser.add_argument("arguments", nargs="*")
    parser.set_defaults(run=run)
