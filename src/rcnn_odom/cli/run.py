"""The command `rcnn-odom run`: estimates poses from a recording or a live laser."""

import argparse
import io
import json
import logging
import math
import shlex
import sys
from collections.abc import Iterable
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rcnn_odom.cli.arguments import (
    Subcommands,
    degrees,
    height,
    laser_pose,
    split_thinning,
    whole_number,
)
from rcnn_odom.cli.full import need_full
from rcnn_odom.errors import InputError

if TYPE_CHECKING:
    from rcnn_odom.deployment.odometer import Pose
    from rcnn_odom.deployment.output import Output
    from rcnn_odom.models.contract import ScanTracker
    from rcnn_odom.recordings.stream import ScanStream

MATCHER, FUSED, OLD_MATCHER_NAME = "matcher", "fused", "icp"
FORMAT_OPTIONS = ("topic", "ring", "height", "field_of_view_deg", "base", "odom_topic")
"""Options of the recording formats."""
RECORDING_OPTIONS = (*FORMAT_OPTIONS[1:], "wheels")
"""Options that do not work with ``--live``."""
WHEEL_OPTIONS, MATCHER_OPTIONS, NETWORK_OPTIONS = ("wheels", "odom_topic"), ("deskew",), ("threads",)
"""Options that work with the matcher only, with the matcher and with ``--model fused``, and with networks."""
WHEEL_CHECK_SCANS = 100
"""Number of first scans among which one must have wheel odometry, if an option asks for it."""


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "run",
        help="estimate poses from a recording or a live laser",
        description="Estimate the trajectory of any 2D laser from a recording, by scan matching or (with "
        "--model) by a trained network. The recording is the folder of a KITTI sequence or of a KITTI raw "
        "drive, a CARMEN log, a ROS bag with LaserScan or PointCloud2 messages (ROS 1, ROS 2 sqlite3 or "
        "mcap; no ROS needed), or a file of JSON lines; it may be packed. The command writes trajectory.txt "
        "(KITTI's format), trajectory.tum, steps.jsonl (each step with its covariance), summary.json and "
        "report.html, a page with figures. "
        "With --live it reads scans as JSON lines from standard input, for instance "
        '{"stamp": 1.0, "ranges": [2.5, ...], "angle_min": -3.14, "angle_increment": 0.0031}, and writes a '
        "pose for each scan to standard output.",
    )
    add = parser.add_argument
    add("paths", nargs="*", metavar="INPUT", help="the recording; INPUT[::3] takes every third scan of it")
    add("--out", type=Path, metavar="DIR", help="folder to write to; it must not contain a trajectory")
    add("--live", action="store_true", help="read scans from standard input, write poses to standard output")
    add(
        "--model",
        metavar="MODEL",
        help="matcher (scan matching, the default), an exported .onnx, a .ckpt, one of the included networks "
        "all_round and half_circle, or fused (scan matching with the steps of a network as priors)",
    )
    add(
        "--network",
        metavar="NETWORK",
        help="network of --model fused: an exported .onnx, an included network (default: all_round), or held",
    )
    add("--every", type=whole_number(1), metavar="N", help="use only every N-th scan")
    _add_outputs(parser)
    _add_poses_and_priors(parser)
    _add_format_options(parser)
    add("--threads", type=whole_number(1), metavar="N", help="number of threads of a network (default: 1)")
    parser.set_defaults(run=lambda arguments: _run(parser, arguments))


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--mcap",
        type=Path,
        metavar="FILE.mcap",
        help="write odometry, path, scans, local map and transforms as ROS 2 messages, for Foxglove or ros2 "
        "bag",
    )
    add(
        "--rerun",
        type=Path,
        metavar="FILE.rrd",
        help="write the same for the viewer of rerun (needs the extra view)",
    )
    add("--view", action="store_true", help="show the run live in the viewer of rerun (needs the extra view)")


def _add_poses_and_priors(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--laser-pose",
        type=laser_pose,
        metavar="X Y HEADING",
        help="pose of the upright laser on the robot in metres, metres and degrees; the output is then the "
        "poses of the robot",
    )
    add(
        "--base",
        metavar="FRAME",
        help="frame of the robot, for instance base_link; the output is then its poses, "
        "with the transforms in /tf_static of a bag",
    )
    add("--wheels", action="store_true", help="use the odometry in a log as the prior of the matcher")
    add(
        "--odom-topic",
        metavar="TOPIC",
        help="use the odometry on this topic of a bag as the prior of the matcher",
    )
    add(
        "--deskew",
        choices=("auto", "on", "off"),
        help="remove the distortion of scans by the motion (auto: on unless it is removed already)",
    )


def _add_format_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--topic", help="topic of the scans, if a bag or JSON lines of rosbridge have several")
    add(
        "--ring",
        type=whole_number(0),
        metavar="N",
        help="ring of KITTI or of a point cloud (default: the most level one)",
    )
    add(
        "--height",
        type=height,
        metavar="LOW:HIGH",
        help="take the points between two heights in metres of a point cloud, not a ring",
    )
    add(
        "--field-of-view-deg",
        type=degrees,
        metavar="DEG",
        help="field of view of the FLASER lines of a CARMEN log (default: that in the log, or 180)",
    )


def _run(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    _check_arguments(parser, arguments)
    outputs = _make_outputs(arguments)
    from rcnn_odom.deployment.odometer import Odometer
    from rcnn_odom.deployment.run import PAGE, run
    from rcnn_odom.deployment.three_lines import format_lines

    logging.basicConfig(format="%(message)s", level=logging.INFO, stream=sys.stderr)
    model = arguments.model or MATCHER
    network = None if model in (MATCHER, FUSED) else _load_network(model, arguments.threads or 1)
    stream = _open_stream(parser, arguments)
    odometer = Odometer(
        network or _build_matcher(arguments, stream), arguments.laser_pose or stream.laser_pose
    )
    if not arguments.live:
        for note in stream.notes:
            print(f"{stream.name}: {note}")
    on_pose = _print_pose if arguments.live else None
    name, settings = Path(model).stem, _given_options(arguments)
    summary = run(odometer, stream, name, arguments.out, on_pose, settings, outputs)
    page = arguments.out / PAGE if arguments.out else None
    # With --live, standard output contains only poses.
    print(format_lines(summary, page), file=sys.stderr if arguments.live else sys.stdout)
    return 0


def _make_outputs(arguments: argparse.Namespace) -> "list[Output]":
    """Creates the outputs other than the folder: files for mcap and rerun, and the viewer.

    Raises:
        InputError: an output cannot be created.
    """
    outputs: list[Output] = []
    if arguments.mcap:
        from rcnn_odom.deployment.mcap_log import McapLog

        outputs.append(McapLog(arguments.mcap, (arguments.base or "base_link").lstrip("/")))
    if arguments.rerun:
        from rcnn_odom.deployment.rerun_log import RerunFile

        outputs.append(RerunFile(arguments.rerun))
    if arguments.view:
        from rcnn_odom.deployment.rerun_log import RerunViewer

        outputs.append(RerunViewer())
    return outputs


def _given_options(arguments: argparse.Namespace) -> dict[str, str]:
    """The options that the user gave, as texts by name, for the report."""
    given = {
        _option_name(name): " ".join(_format_value(name, value)) or "yes"
        for name, value in vars(arguments).items()
        if name not in ("paths", "out", "run") and value not in (None, False)
    }
    return {"INPUT": " ".join(arguments.paths), **given} if arguments.paths else given


def _check_arguments(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Checks that the options can be combined; ends the process with a usage error if not.

    Raises:
        InputError: the model is given before the recording or under its old name, as in earlier versions.
    """
    _refuse_old_order(arguments)
    if arguments.model == OLD_MATCHER_NAME:
        raise InputError(
            f"--model {OLD_MATCHER_NAME} is now --model {MATCHER}, the default; leave out --model"
        )
    if len(arguments.paths) != (0 if arguments.live else 1):
        parser.error("give one INPUT or --live")
    if not (arguments.live or arguments.out or arguments.mcap or arguments.rerun or arguments.view):
        parser.error("--out DIR is needed, or --mcap, --rerun or --view")
    if arguments.base and arguments.laser_pose:
        parser.error("--base and --laser-pose both set the pose of the laser; give only one of them")
    if arguments.wheels and arguments.odom_topic:
        parser.error("--wheels and --odom-topic choose different odometry; give only one of them")
    is_matcher, is_fused = arguments.model in (None, MATCHER), arguments.model == FUSED
    for names, is_refused, reason in (
        (RECORDING_OPTIONS, arguments.live, "works only with recordings, not with --live"),
        (WHEEL_OPTIONS, is_fused, "works only with the matcher; the prior of --model fused is a network"),
        (("network",), not is_fused, "works only with --model fused"),
        (
            WHEEL_OPTIONS + MATCHER_OPTIONS,
            not (is_matcher or is_fused),
            "works only with the matcher, not with a network",
        ),
        (NETWORK_OPTIONS, is_matcher, "works only with a network (--model), not with the matcher"),
    ):
        for name in names:
            if is_refused and getattr(arguments, name) not in (None, False):
                parser.error(f"{_option_name(name)} {reason}")


def _refuse_old_order(arguments: argparse.Namespace) -> None:
    """Refuses ``run MODEL INPUT`` and ``run MODEL --live`` of earlier versions.

    Raises:
        InputError: with the command of this version.
    """
    paths = arguments.paths
    if arguments.model or len(paths) != (1 if arguments.live else 2):
        return
    from rcnn_odom.deployment.shipped import shipped_models

    model = paths[0]
    if not (model.endswith((".onnx", ".ckpt")) or model in (MATCHER, *shipped_models())):
        return
    words = ["rcnn-odom", "run", *paths[1:], "--model", model]
    for name, value in vars(arguments).items():
        if name not in ("paths", "model", "run") and value not in (None, False):
            words += [_option_name(name), *_format_value(name, value)]
    raise InputError(f"the recording comes first, and the model is an option: {shlex.join(words)}")


def _option_name(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _format_value(name: str, value: Any) -> list[str]:
    """Formats the value of an option as the words of the command line."""
    if name == "laser_pose":
        x, y, heading = value
        return [f"{x:g}", f"{y:g}", f"{math.degrees(heading):g}"]
    if name == "height":
        return [":".join(f"{each:g}" for each in value)]
    return [] if value is True else [str(value)]


def _open_stream(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> "ScanStream":
    """Opens the scans of the recording or of standard input.

    Raises:
        InputError: there is no such recording, or it lacks data that an option needs.
    """
    from rcnn_odom.recordings import json_lines
    from rcnn_odom.recordings.formats import open_stream
    from rcnn_odom.recordings.stream import thin

    if arguments.live:
        stream = _assume_even_turns(arguments, json_lines.stream_lines(_read_live(), topic=arguments.topic))
        return thin(stream, arguments.every or 1)
    path, every = split_thinning(arguments.paths[0])
    if every and arguments.every:
        parser.error(f"--every and [::{every}] have the same meaning; give only one of them")
    options = {name: getattr(arguments, name) for name in FORMAT_OPTIONS}
    if arguments.odom_topic:
        options["laser_pose"] = arguments.laser_pose  # It transforms the odometry to the laser.
    stream = _assume_even_turns(arguments, open_stream(path, options))
    if arguments.wheels or arguments.odom_topic:
        stream = _check_wheel_odometry(stream, "--wheels" if arguments.wheels else "--odom-topic")
    return thin(stream, every or arguments.every or 1)


def _assume_even_turns(arguments: argparse.Namespace, stream: "ScanStream") -> "ScanStream":
    """With ``--deskew on``, computes the times of the beams if only the time of a whole turn is known."""
    from rcnn_odom.recordings.laser_scan import assume_even_turn

    return replace(stream, scans=map(assume_even_turn, stream.scans)) if arguments.deskew == "on" else stream


def _check_wheel_odometry(stream: "ScanStream", option: str) -> "ScanStream":
    """Checks that one of the first scans has wheel odometry; returns the same stream with all its scans.

    Raises:
        InputError: none of them has.
    """
    first = list(islice(stream.scans, WHEEL_CHECK_SCANS))
    if first and not any(scan.wheel_pose for scan in first):
        advice = f"leave out {option}" + (
            "; for a bag, name its topic with --odom-topic" if option == "--wheels" else ""
        )
        raise InputError(f"{stream.name}: its scans have no wheel odometry; {advice}")
    return replace(stream, scans=chain(first, stream.scans))


def _read_live() -> Iterable[str]:
    """The lines of standard input.

    Raises:
        InputError: standard input is closed.
    """
    if sys.stdin is None:
        raise InputError("standard input is closed; --live reads scans from it")
    if isinstance(sys.stdin, io.TextIOWrapper):
        # Invalid bytes are replaced, so that their line is skipped because it is not a scan.
        sys.stdin.reconfigure(encoding="utf-8", errors="replace")
    return sys.stdin


def _print_pose(pose: "Pose") -> None:
    print(json.dumps(pose.as_dict()), flush=True)


def _build_matcher(arguments: argparse.Namespace, stream: "ScanStream") -> "ScanTracker":
    from rcnn_odom.models.matcher import MatcherTracker
    from rcnn_odom.recordings.recording import wants_deskew

    deskew = wants_deskew(arguments.deskew or "auto", stream.is_compensated)
    if arguments.model == FUSED:
        from rcnn_odom.models.fused import FusedOptions, fused_tracker

        return fused_tracker(arguments.network or FusedOptions.network, deskew, arguments.threads or 1)
    return MatcherTracker(wheels=bool(arguments.wheels or arguments.odom_topic), deskew=deskew)


def _load_network(model: str, threads: int) -> "ScanTracker":
    if model.endswith(".ckpt"):
        need_full(f"{model}: a checkpoint")
        from rcnn_odom.training.export import load_odometer

        return load_odometer(Path(model), threads).tracker
    from rcnn_odom.deployment.odometer import Odometer

    return Odometer.from_onnx(model, threads=threads).tracker
