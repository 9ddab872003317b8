"""`rcnn-odom evaluate`: scores a finished run again, or a model that does not train."""

import argparse

from rcnn_odom.cli.arguments import Subcommands
from rcnn_odom.cli.full import add_passing_on


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    about = "score a run or a model again: evaluate run=outputs/latest; evaluate --help shows all"
    add_passing_on(commands, "evaluate", _run_evaluate, about)


def _run_evaluate(arguments: argparse.Namespace) -> int:
    from rcnn_odom.training.entry import run_evaluate

    return run_evaluate(arguments.arguments)
