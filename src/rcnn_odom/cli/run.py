"""`rcnn-odom run`: poses from a recording or a live laser."""

import argparse
import io
import json
import logging
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from rcnn_odom.cli.arguments import Subcommands, degrees, height, whole_number
from rcnn_odom.errors import InputError

if TYPE_CHECKING:
    from rcnn_odom.deployment.odometer import Odometer, Pose


FORMAT_OPTIONS = ("topic", "ring", "height", "field_of_view_deg")
"""Options that are a format's own."""


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "run",
        help="poses from a recording or a live laser",
        description="Estimate the trajectory of a recording: a folder of a KITTI sequence or of a KITTI raw "
        "drive, a CARMEN log, a ROS bag with LaserScan or PointCloud2 messages (ROS 1, ROS 2 sqlite3 or "
        "mcap; no ROS needed), or a file of JSON lines; packed ones too. Writes trajectory.txt "
        "(KITTI), trajectory.tum, steps.jsonl (each step with its uncertainty), map.png and summary.json. "
        "With --live: scans as JSON lines from standard input, such as "
        '{"stamp": 1.0, "ranges": [2.5, ...], "angle_min": -3.14, "angle_increment": 0.0031}, and a pose '
        "for each on standard output.",
    )
    add = parser.add_argument
    add(
        "paths",
        nargs="*",
        metavar="MODEL INPUT",
        help="the model, unless --model names it, and the recording",
    )
    add("--model", metavar="MODEL", help="an exported .onnx, a .ckpt, or rcnn_small, which ships along")
    add("--live", action="store_true", help="read scans from standard input, write poses to standard output")
    add("--out", type=Path, metavar="DIR", help="folder to write to; must not hold a trajectory yet")
    add("--topic", help="of the messages in a bag, or in JSON lines of rosbridge, that has several")
    add("--ring", type=whole_number(0), metavar="N", help="of KITTI or a point cloud (the most level one)")
    add("--height", type=height, metavar="LOW:HIGH", help="metres: cuts a slice of a point cloud, not a ring")
    add(
        "--field-of-view-deg",
        type=degrees,
        metavar="DEG",
        help="that the beams of a CARMEN log's FLASER lines cover (what the log says, or 180)",
    )
    add("--threads", type=whole_number(1), default=1, metavar="N", help="of the computation (%(default)s)")
    parser.set_defaults(run=lambda arguments: _run(parser, arguments))


def _run(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    paths = [arguments.model, *arguments.paths] if arguments.model else arguments.paths
    if len(paths) != (1 if arguments.live else 2):
        parser.error("give MODEL and either INPUT or --live")
    if not arguments.live and arguments.out is None:
        parser.error("--out DIR is needed")
    of_files = [name for name in FORMAT_OPTIONS if name != "topic" and getattr(arguments, name) is not None]
    if arguments.live and of_files:
        parser.error(f"--{of_files[0].replace('_', '-')} is of recordings, not of --live")

    from rcnn_odom.deployment.run import format_summary, run
    from rcnn_odom.recordings import json_lines
    from rcnn_odom.recordings.formats import open_stream

    logging.basicConfig(format="%(message)s", level=logging.INFO, stream=sys.stderr)
    odometer, model = _load(paths[0], arguments.threads), Path(paths[0]).stem
    if arguments.live:
        lines = _read_live()
        summary = run(
            odometer, json_lines.stream_lines(lines, topic=arguments.topic), model, arguments.out, _print_pose
        )
        print(format_summary(summary), file=sys.stderr)
        return 0
    options = {name: getattr(arguments, name) for name in FORMAT_OPTIONS}
    stream = open_stream(Path(paths[1]), options)
    for note in stream.notes:
        print(f"{stream.name}: {note}")
    print(format_summary(run(odometer, stream, model, arguments.out)))
    print(f"all of it is in {shlex.quote(str(arguments.out))}")
    return 0


def _read_live() -> Iterable[str]:
    """The lines of standard input.

    Raises:
        InputError: there is none.
    """
    if sys.stdin is None:
        raise InputError("standard input is closed; --live reads scans from it")
    if isinstance(sys.stdin, io.TextIOWrapper):
        # Bytes that are no text are a line that is no scan.
        sys.stdin.reconfigure(encoding="utf-8", errors="replace")
    return sys.stdin


def _print_pose(pose: "Pose") -> None:
    print(json.dumps(pose.as_dict()), flush=True)


def _load(model: str, threads: int) -> "Odometer":
    if model.endswith(".ckpt"):
        from rcnn_odom.training.export import load_odometer

        return load_odometer(Path(model), threads)
    from rcnn_odom.deployment.odometer import Odometer

    return Odometer.from_onnx(model, threads=threads)
