"""`rcnn-odom export`: a checkpoint as one file for robots."""

import argparse
import os
from pathlib import Path

from rcnn_odom.cli.arguments import Subcommands


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "export",
        help="write a trained network as an ONNX file",
        description="Write the network of a run as one ONNX file: a pair of scans in, a step and its "
        "covariance out, the network's state explicit, with the sensor and the encoding of scans in its "
        "metadata. The file is compared with the checkpoint step by step, and the drift of each precision on "
        "the run's test sequences is printed. int8 that costs more than 0.1 percentage points of drift is "
        "not written.",
    )
    parser.add_argument(
        "checkpoint", type=Path, metavar="CKPT", help="RUN/checkpoints/best.ckpt, or the run's folder"
    )
    parser.add_argument("--format", choices=["onnx"], default="onnx", help="of the file (%(default)s)")
    parser.add_argument(
        "--quantize", choices=["int8"], help="weights of the products in 8 bits: a quarter of the size"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="to write (RUN/model.onnx or RUN/model_int8.onnx)",
    )
    parser.add_argument(
        "--fit-on",
        nargs="+",
        metavar="NAME",
        help="drives to fit the uncertainty of steps on anew, in place of the run's validation drives; more "
        "of them know more. They must be neither trained nor tested on. The checkpoint keeps its own",
    )
    parser.add_argument(
        "--no-drift",
        action="store_true",
        help="where the recordings are not at hand: compare with the checkpoint on random scans alone",
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
