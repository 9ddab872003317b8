"""Commands that need the full distribution; ``rcnn-odom-robot`` has no training and does not contain them."""

import argparse
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

from rcnn_odom.cli.arguments import Subcommands
from rcnn_odom.errors import InputError


def is_full() -> bool:
    """Whether the full distribution is installed: training, PyTorch, Lightning and Hydra."""
    found = find_spec("rcnn_odom.training")
    # Without an origin it is an empty folder that an uninstalled distribution left behind.
    return found is not None and found.origin is not None


def need_full(what: str) -> None:
    """Checks that the full distribution is installed.

    Args:
        what: what needs it, the subject of the error message.

    Raises:
        InputError: only ``rcnn-odom-robot`` is installed; the message says what to install.
    """
    if not is_full():
        raise InputError(
            f"{what} needs the full distribution, not only rcnn-odom-robot: pip install rcnn-odom"
        )


def add_missing(commands: Subcommands, name: str) -> None:
    """Adds a command that accepts any arguments and only raises the error that says what to install."""
    add_forwarding_command(
        commands, name, partial(_raise_missing, name), "needs the full distribution: pip install rcnn-odom"
    )


def _raise_missing(name: str, _: argparse.Namespace) -> int:
    need_full(f"rcnn-odom {name}")
    raise AssertionError("the full distribution is installed, but the command was added as missing")


def add_forwarding_command(
    commands: Subcommands, name: str, run: Callable[[argparse.Namespace], int], description: str
) -> None:
    """Adds a command that forwards all its arguments unchanged, including ``--help``.

    Args:
        commands: the commands of ``rcnn-odom``.
        name: name of the command.
        run: function that gets the forwarded texts as ``arguments`` and returns the exit status.
        description: one line of help.
    """
    # No argument starts with this character, so argparse reads none of them as an option.
    parser = commands.add_parser(name, help=description, add_help=False, prefix_chars="\0")
    parser.add_argument("arguments", nargs="*")
    parser.set_defaults(run=run)
