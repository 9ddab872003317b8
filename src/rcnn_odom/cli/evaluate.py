"""The command `rcnn-odom evaluate`: scores a finished run again, or a model without training."""

import argparse

from rcnn_odom.cli.arguments import Subcommands
from rcnn_odom.cli.full import add_forwarding_command


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    description = "score a run, or a model without training: evaluate run=outputs/latest; see evaluate --help"
    add_forwarding_command(commands, "evaluate", _run_evaluate, description)


def _run_evaluate(arguments: argparse.Namespace) -> int:
    from rcnn_odom.training.entry import run_evaluate

    return run_evaluate(arguments.arguments)
