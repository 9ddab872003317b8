"""What to do where scans were dropped: ``python -m rcnn_odom.comparison.gaps RUN``.

A network can still compare the scans at both ends of a gap, or the last motion can go on over it. Both are
measured on the run's validation drives, with gaps that begin every ``EVERY`` scans, none of which changes the
LSTM's state.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rcnn_odom.evaluation.scores import aligned
from rcnn_odom.geometry import FloatArray, motion_errors, relative_motions
from rcnn_odom.recordings.cache import EncodedSequence
from rcnn_odom.training.checkpoint import load_module
from rcnn_odom.training.modules import OdometryModule
from rcnn_odom.training.run_state import BEST, read_settings
from rcnn_odom.training.stages import build_datamodule

EVERY = 20
GAPS = (1, 2, 3, 4)
"""Periods from one scan to the next; 1 is no gap."""


def main() -> int:
    """Prints a table with the mean absolute errors of both ways."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a finished run")
    run = parser.parse_args().run
    module = load_module(run / BEST)
    drives = build_datamodule(read_settings(run)).load(("val",)).sequences["val"]
    rows = [["periods", "compared, m", "deg", "held, m", "deg", "gaps"]]
    for periods in GAPS:
        errors = np.concatenate([gap_errors(module, drive, periods) for drive in drives])
        mean = np.abs(errors).mean(0)
        numbers = [f"{mean[way, 0]:.3f} {np.rad2deg(mean[way, 1]):.3f}".split() for way in (0, 1)]
        rows.append([str(periods), *numbers[0], *numbers[1], str(len(errors))])
    print(aligned(rows))
    return 0


@torch.no_grad()
def gap_errors(module: OdometryModule, drive: EncodedSequence, periods: int) -> FloatArray:
    """Errors (N, 2, 2) in metres and radians of comparing over a gap, and of holding the last motion."""
    scans = torch.from_numpy(np.array(drive.scans))

    def pair(earlier: int, later: int) -> Tensor:
        return scans[[earlier, later]][None, None]

    state, last, errors = None, np.zeros(2), []
    for frame in range(len(drive) - max(GAPS)):
        if frame % EVERY == EVERY - 1:
            compared = (
                module.network(pair(frame, frame + periods), state)[0].motion.flatten().double().numpy()
            )
            truth = relative_motions(drive.poses[[frame, frame + periods]])
            errors.append(
                np.stack([motion_errors(way[None], truth)[0] for way in (compared, periods * last)])
            )
        estimate, state = module.network(pair(frame, frame + 1), state)
        last = estimate.motion.flatten().double().numpy()
    return np.stack(errors)


if __name__ == "__main__":
    sys.exit(main())
