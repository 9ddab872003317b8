"""`rcnn-odom ...`: jobs on files that are not experiments."""

import argparse
import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rcnn_odom import __version__
from rcnn_odom.errors import InputError

if TYPE_CHECKING:
    from rcnn_odom.metrics.drift import Drift

# Heavy imports stay inside the commands, so that --help answers at once.


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments without the program's name; None takes those of the process.

    Returns:
        Exit status: 0, or 1 after one line on stderr about bad input, or 130 after Ctrl-C. Wrong usage
        exits with 2.
    """
    arguments = _build_parser().parse_args(argv)
    try:
        status: int = arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader (`| head`) has gone. Python would complain about it once more at exit.
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
    parser = argparse.ArgumentParser(prog="rcnn-odom", description="Jobs on files of laser odometry.")
    parser.add_argument("--version", action="version", version=f"rcnn-odom {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_drift(commands)
    _add_frames(commands)
    _add_simulate(commands)
    return parser


def _add_drift(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = commands.add_parser(
        "drift",
        help="score a trajectory against the ground truth by KITTI's rule",
        description="Score a trajectory against the ground truth by the rule of KITTI's development kit. "
        "Both files are in KITTI's format: 12 numbers a line, camera frame.",
    )
    parser.add_argument("truth", type=Path, metavar="GT.txt", help="ground truth")
    parser.add_argument("estimate", type=Path, metavar="EST.txt", help="estimate of the same frames")
    parser.add_argument("--planar", action="store_true", help="flatten both to the x-z plane first")
    parser.add_argument(
        "--lengths",
        type=_parse_lengths,
        metavar="M,M,...",
        help="segment lengths in metres (100,200,...,800)",
    )
    parser.add_argument(
        "--step",
        type=_whole_number(1),
        default=10,
        metavar="N",
        help="frames between segment starts (%(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON: ratios, degrees per metre")
    parser.set_defaults(run=_run_drift)


def _parse_lengths(text: str) -> tuple[float, ...]:
    try:
        lengths = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of numbers such as 10,20,50") from None
    if not all(math.isfinite(length) and length > 0 for length in lengths):
        raise argparse.ArgumentTypeError(f"{text!r}: lengths must be positive")
    return lengths


def _whole_number(least: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, {least} or more")
        return int(text)

    return parse


def _run_drift(arguments: argparse.Namespace) -> int:
    from rcnn_odom.metrics.drift import KITTI_LENGTHS, drift, fitting_lengths, travelled
    from rcnn_odom.trajectory import flatten, read_kitti

    truth, estimate = read_kitti(arguments.truth), read_kitti(arguments.estimate)
    lengths = sorted(set(arguments.lengths or KITTI_LENGTHS))
    result = drift(truth, estimate, planar=arguments.planar, lengths=lengths, step=arguments.step)
    if arguments.json:
        print(json.dumps({**result.to_dict(), "planar": arguments.planar, "lengths": lengths}, indent=2))
        return 0
    truth = flatten(truth) if arguments.planar else truth
    path = travelled(truth)[-1]
    missing = ", ".join(f"{length:g}" for length in lengths if length not in result.per_length)
    nothing = f"no segment of {missing} m in a path of {path:.4g} m"
    if result.segments == 0:
        fitting = ",".join(f"{length:g}" for length in fitting_lengths([truth], lengths))
        raise InputError(f"{nothing}: try --lengths {fitting}")
    print(_format_drift(result, arguments.planar, arguments.step))
    if missing:
        print(f"\n{nothing}")
    return 0


def _format_drift(result: "Drift", planar: bool, step: int) -> str:
    """A table for people: percent and degrees."""
    assert result.t_err is not None
    assert result.t_rmse is not None
    assert result.r_err_deg_per_m is not None
    plane = "planar (x-z)" if planar else "full 3D"
    lines = [
        f"drift               {100 * result.t_err:9.4f} %      (ratio {result.t_err:.6f})",
        f"RMSE over segments  {100 * result.t_rmse:9.4f} %      (ratio {result.t_rmse:.6f})",
        f"rotational drift    {result.r_err_deg_per_m:9.6f} deg/m",
        f"segments            {result.segments:9d}        (a start every {step} frames, {plane})",
        "",
        "length (m)  segments  drift (%)  rotation (deg/m)",
    ]
    for length, part in result.per_length.items():
        rotation = f"{part.r_err_deg_per_m:16.6f}"
        lines.append(f"{length:10g}  {part.segments:8d}  {100 * part.t_err:9.4f}  {rotation}")
    return "\n".join(lines)


def _add_frames(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = commands.add_parser(
        "frames",
        help="errors of a drive's single frames",
        description="Errors of distance and heading a frame, against the truth and against a smoothed true "
        "distance (that of a GPS jitters), and of the end point of the motions put together.",
    )
    parser.add_argument("motions", type=Path, metavar="MOTIONS.csv", help="RUN/trajectories/*_motions.csv")
    parser.add_argument(
        "--frames",
        type=_parse_frames,
        metavar="FIRST:LAST",
        help="only these, both included, such as 20:39; a frame is the motion to the scan of its number",
    )
    parser.add_argument(
        "--apply",
        choices=["start", "middle", "end"],
        default="end",
        help="where along its turn a step is taken (%(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON; end_ratio is a ratio, not percent")
    parser.set_defaults(run=_run_frames)


def _parse_frames(text: str) -> tuple[int, int]:
    first, _, last = text.partition(":")
    if not (first.isdecimal() and last.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a range of frames such as 20:39")
    if int(first) > int(last):
        raise argparse.ArgumentTypeError(f"{text!r} is empty: its last frame comes before its first")
    return int(first), int(last)


def _run_frames(arguments: argparse.Namespace) -> int:
    from rcnn_odom.evaluation import frame_table, stretch_errors
    from rcnn_odom.trajectory import read_motions

    truth, estimates = read_motions(arguments.motions)
    first, last = arguments.frames or (1, len(truth))
    if first < 1 or last > len(truth):
        raise InputError(
            f"{arguments.motions}: --frames {first}:{last} reaches outside of the drive, "
            f"which has {len(truth)} frames: 1:{len(truth)}"
        )
    chosen = slice(first - 1, last)
    reports = {
        method: stretch_errors(motions, truth, chosen, arguments.apply)
        for method, motions in estimates.items()
    }
    if arguments.json:
        print(json.dumps({"frames": [first, last], "apply": arguments.apply, "methods": reports}, indent=2))
        return 0
    path = reports["estimate"]["path_m"]
    print(f"frames {first} to {last} of {len(truth)}, a path of {path:.2f} m\n\n{frame_table(reports)}")
    return 0


def _add_simulate(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = commands.add_parser(
        "simulate",
        help="write simulated drives in KITTI's layout",
        description="Write simulated drives as DIR/sequences/NAME/{velodyne/*.bin,calib.txt,times.txt} and "
        "DIR/poses/NAME.txt, for data=kitti and other tools. The same options give the same files.",
    )
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="folder to write to, made where missing")
    add("--layout", choices=["kitti"], default="kitti", help="layout of the files (%(default)s)")
    add(
        "--sequence",
        nargs="+",
        default=["00"],
        metavar="NAME",
        help="any names, each a world and a drive of its own (00)",
    )
    add(
        "--frames",
        type=_whole_number(2),
        metavar="N",
        help="scans in each sequence, whatever its name and scale",
    )
    add(
        "--scale",
        choices=["small", "full"],
        default="small",
        help="full: 00 to 10 have as many scans as KITTI's; small: a tenth, 800 for 05, 07 and 10. "
        "Other names have 600 (%(default)s)",
    )
    add(
        "--world",
        choices=["street", "indoor"],
        default="street",
        help="street: a car in a city; indoor: a robot with a 180-degree laser (%(default)s)",
    )
    add(
        "--seed",
        type=_whole_number(0),
        default=0,
        metavar="S",
        help="another number gives other worlds (%(default)s)",
    )
    add(
        "--without",
        action="append",
        choices=["movers", "missing", "tilt"],
        default=[],
        help="leave out what moves, missing returns, or slopes and the car's tilt; can be repeated",
    )
    parser.set_defaults(run=_run_simulate)


def _run_simulate(arguments: argparse.Namespace) -> int:
    from rcnn_odom.datasets import simulated
    from rcnn_odom.datasets.export import export_kitti, need_free_name

    root, names = arguments.out, list(dict.fromkeys(arguments.sequence))
    for name in names:
        need_free_name(root, name)
    for name in names:
        sequence = simulated.load(
            name,
            world=arguments.world,
            scale=arguments.scale,
            frames=arguments.frames,
            seed=arguments.seed,
            movers="movers" not in arguments.without,
            missing="missing" not in arguments.without,
            tilt="tilt" not in arguments.without,
        )
        export_kitti(sequence, root)
    tests = shlex.quote(f"data.test={json.dumps(names, ensure_ascii=False)}")
    command = f"python evaluate.py data=kitti {shlex.quote(f'data.root={root}')} {tests}"
    for option, value in simulated.SENSORS[arguments.world].items():
        command += f" data.sensor.{option}={value:g}"
    print(f"wrote {', '.join(names)} to {root}; score a trained network there: {command}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
