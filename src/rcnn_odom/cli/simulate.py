"""The command `rcnn-odom simulate`: writes simulated drives as files."""

import argparse
import json
import shlex
from collections.abc import Callable
from pathlib import Path

from rcnn_odom.cli.arguments import Subcommands, whole_number
from rcnn_odom.cli.full import is_full


def add(commands: Subcommands) -> None:
    """Adds the command to ``rcnn-odom``."""
    parser = commands.add_parser(
        "simulate",
        help="write simulated drives in KITTI's layout",
        description="Write simulated drives as DIR/sequences/NAME/{velodyne/*.bin,calib.txt,times.txt} and "
        "DIR/poses/NAME.txt, for data=kitti and for other tools. The same options give the same files.",
    )
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="folder to write to; it is created if missing")
    add("--layout", choices=["kitti"], default="kitti", help="layout of the files (default: %(default)s)")
    add(
        "--sequence",
        nargs="+",
        default=["00"],
        metavar="NAME",
        help="names of the sequences; each name gives another world and drive (default: 00)",
    )
    add(
        "--frames",
        type=whole_number(2),
        metavar="N",
        help="number of scans in each sequence (default: depends on its name and --scale)",
    )
    _add_world(add)
    parser.set_defaults(run=_run_simulate)


def _add_world(add: Callable[..., argparse.Action]) -> None:
    """Adds the options that describe the simulated worlds."""
    add(
        "--scale",
        choices=["small", "full"],
        default="small",
        help="number of scans. full: 00 to 10 have as many as KITTI's sequences; small: a tenth of them, but "
        "800 for 05, 07 and 10. Other names have 600 (default: %(default)s)",
    )
    add(
        "--world",
        choices=["street", "indoor"],
        default="street",
        help="street: a car in a city; indoor: a robot with a 180-degree laser (default: %(default)s)",
    )
    add(
        "--seed",
        type=whole_number(0),
        default=0,
        metavar="S",
        help="seed of the worlds (default: %(default)s)",
    )
    add(
        "--without",
        action="append",
        choices=["movers", "missing", "tilt"],
        default=[],
        help="leave out moving objects (movers), missing returns (missing), or slopes and the car's tilt "
        "(tilt); can be repeated",
    )


def _run_simulate(arguments: argparse.Namespace) -> int:
    from rcnn_odom.recordings import simulated
    from rcnn_odom.recordings.kitti_writer import export_kitti, need_free_name

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
    message = f"wrote {', '.join(names)} to {shlex.quote(str(root))}"
    if is_full():
        command = _scoring_command(root, names, simulated.SENSORS[arguments.world])
        message += f"; score a trained network on them: {command}"
    print(message)
    return 0


def _scoring_command(root: Path, names: list[str], sensor: dict[str, float]) -> str:
    """The command that scores a network on the drives, quoted for a shell."""
    from rcnn_odom.training.overrides import written

    tests = shlex.quote(f"data.test={json.dumps(names, ensure_ascii=False)}")
    command = f"rcnn-odom evaluate data=kitti {written('data.root', str(root))} {tests}"
    return command + "".join(f" data.sensor.{option}={value:g}" for option, value in sensor.items())
