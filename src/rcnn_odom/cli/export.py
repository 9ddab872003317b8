"""The command `rcnn-odom export`: writes a checkpoint as one ONNX file for robots."""

import argparse
import os
from pathlib import Path

from rcnn_odom.cli.arguments import Subcommands


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "export",
        help="write a trained network as an ONNX file",
        description="Write the network of a run as one ONNX file. Its input is a pair of scans and the "
        "network's state; its output is a step with covariance and the next state. Its metadata contain the "
        "sensor and the encoding of scans. The file is compared with the checkpoint step by step, and the "
        "drift of each precision on the run's test sequences is printed. An int8 file is not written if it "
        "increases the drift by more than 0.1 percentage points.",
    )
    parser.add_argument(
        "checkpoint", type=Path, metavar="CKPT", help="RUN/checkpoints/best.ckpt, or the run's folder"
    )
    parser.add_argument(
        "--format", choices=["onnx"], default="onnx", help="format of the file (default: %(default)s)"
    )
    parser.add_argument(
        "--quantize",
        choices=["int8"],
        help="store the weights of matrix products in 8 bits, which quarters the file size",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="file to write (default: RUN/model.onnx or RUN/model_int8.onnx)",
    )
    parser.add_argument(
        "--fit-on",
        nargs="+",
        metavar="NAME",
        help="fit the covariance of steps on these drives, not on the run's validation drives; more drives "
        "give a better fit. They must not be training or test drives. The checkpoint is not changed",
    )
    parser.add_argument(
        "--no-drift",
        action="store_true",
        help="do not compute the drift, and compare with the checkpoint on random scans only; needs no "
        "recordings",
    )
    parser.set_defaults(run=_run_export)


def _run_export(arguments: argparse.Namespace) -> int:
    from rcnn_odom.evaluation.run_folder import BEST
    from rcnn_odom.training.export import export_checkpoint, export_unscored

    checkpoint = arguments.checkpoint
    if checkpoint.is_dir():
        checkpoint = checkpoint / BEST
    run = Path(os.path.relpath(checkpoint.resolve().parents[1]))
    precision = arguments.quantize or "fp32"
    name = "model_int8.onnx" if arguments.quantize else "model.onnx"
    out = arguments.out or run / name
    if arguments.no_drift:
        export_unscored(checkpoint, out, precision)
    else:
        export_checkpoint(checkpoint, run, out, precision, arguments.fit_on)
    return 0
