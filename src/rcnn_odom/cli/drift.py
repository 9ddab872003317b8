"""The command `rcnn-odom drift`: scores a trajectory against the ground truth."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from rcnn_odom.cli.arguments import Subcommands, metres, whole_number
from rcnn_odom.errors import InputError

if TYPE_CHECKING:
    from rcnn_odom.evaluation.drift import Drift


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "drift",
        help="score a trajectory against the ground truth by KITTI's rule",
        description="Score a trajectory against the ground truth by the rule of KITTI's development kit. "
        "Both files are in KITTI's format: 12 numbers a line, camera frame.",
    )
    parser.add_argument("truth", type=Path, metavar="GT.txt", help="ground truth")
    parser.add_argument("estimate", type=Path, metavar="EST.txt", help="estimate of the same frames")
    parser.add_argument("--planar", action="store_true", help="project both on the x-z plane first")
    parser.add_argument(
        "--lengths",
        type=_parse_lengths,
        metavar="M,M,...",
        help="segment lengths in metres (default: 100,200,...,800)",
    )
    parser.add_argument(
        "--step",
        type=whole_number(1),
        default=10,
        metavar="N",
        help="frames between the starts of segments (default: %(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON with ratios and degrees per metre")
    parser.set_defaults(run=_run_drift)


def _parse_lengths(text: str) -> tuple[float, ...]:
    return tuple(map(metres, text.split(",")))


def _run_drift(arguments: argparse.Namespace) -> int:
    from rcnn_odom.evaluation.drift import KITTI_LENGTHS, drift, fitting_lengths, travelled
    from rcnn_odom.recordings.trajectory import flatten, read_kitti

    truth, estimate = read_kitti(arguments.truth), read_kitti(arguments.estimate)
    lengths = sorted(set(arguments.lengths or KITTI_LENGTHS))
    result = drift(truth, estimate, planar=arguments.planar, lengths=lengths, step=arguments.step)
    if arguments.json:
        print(json.dumps({**result.to_dict(), "planar": arguments.planar, "lengths": lengths}, indent=2))
        return 0
    truth = flatten(truth) if arguments.planar else truth
    path = travelled(truth)[-1]
    missing = ", ".join(f"{length:g}" for length in lengths if length not in result.per_length)
    no_segments = f"no segment of {missing} m in a path of {path:.4g} m"
    if result.segments == 0:
        fitting = ",".join(f"{length:g}" for length in fitting_lengths([truth], lengths))
        raise InputError(f"{no_segments}: try --lengths {fitting}")
    print(_format_drift(result, arguments.planar, arguments.step))
    if missing:
        print(f"\n{no_segments}")
    return 0


def _format_drift(result: "Drift", planar: bool, step: int) -> str:
    """Formats the drift as text in percent and degrees."""
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
