"""The command `rcnn-odom train`: trains and scores one model."""

import argparse

from rcnn_odom.cli.arguments import Subcommands
from rcnn_odom.cli.full import add_forwarding_command


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    description = "train and score a model: train model=rcnn_reg data=kitti data.root=DIR; see train --help"
    add_forwarding_command(commands, "train", _run_train, description)


def _run_train(arguments: argparse.Namespace) -> int:
    from rcnn_odom.training.entry import run_train

    return run_train(arguments.arguments)
