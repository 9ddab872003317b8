"""The command `rcnn-odom`. Each of its subcommands is one file of this package."""

import argparse
import os
import sys
from collections.abc import Sequence

from rcnn_odom import __version__
from rcnn_odom.cli import drift, evaluate, export, frames, relations, report, run, simulate, train
from rcnn_odom.cli.arguments import join_signed
from rcnn_odom.cli.full import add_missing, is_full
from rcnn_odom.errors import InputError
from rcnn_odom.terminal import show_any_text

# Slow imports stay inside the commands, so that --help is fast.

FULL_COMMANDS = {"train": train, "evaluate": evaluate, "report": report, "export": export}
"""Commands that ``rcnn-odom-robot`` does not have."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        argv: arguments without the name of the program; None takes those of the process.

    Returns:
        Exit status: 0; 1 after one line on stderr about wrong input; 130 after Ctrl-C. Wrong usage of the
        options ends the process with status 2.
    """
    show_any_text()
    arguments = _build_parser().parse_args(join_signed(sys.argv[1:] if argv is None else argv))
    try:
        status: int = arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of a pipe (`| head`) has ended. Without this, Python would print an error at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (InputError, OSError) as error:
        print(f"rcnn-odom: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("rcnn-odom: interrupted", file=sys.stderr)
        return 130
    return status


def _build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="rcnn-odom", description="Odometry from a 2D laser.")
    parser.add_argument("--version", action="version", version=f"rcnn-odom {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in (run, drift, frames, relations, simulate):
        command.add(commands)
    for name, command in FULL_COMMANDS.items():
        command.add(commands) if is_full() else add_missing(commands, name)
    return parser
