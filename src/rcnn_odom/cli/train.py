"""`rcnn-odom train`: trains and scores one model."""

import argparse

from rcnn_odom.cli.arguments import Subcommands
from rcnn_odom.cli.full import add_passing_on


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    about = "train and score a model: train model=rcnn_reg data=kitti data.root=DIR; train --help shows all"
    add_passing_on(commands, "train", _run_train, about)


def _run_train(arguments: argparse.Namespace) -> int:
    from rcnn_odom.training.entry import run_train

    return run_train(arguments.arguments)
