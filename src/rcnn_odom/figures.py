"""The figures of the paper: trajectories, and the motion of each frame."""

from typing import TYPE_CHECKING

import numpy as np

from rcnn_odom.motion import FloatArray, poses_to_planar

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRUTH, ESTIMATE = "tab:blue", "tab:red"
"""The paper's colours."""


def trajectory_figure(title: str, truth: FloatArray, estimate: FloatArray) -> "Figure":
    """Estimate over truth, seen from above (paper fig. 4).

    Args:
        title: above the axes.
        truth, estimate: laser poses (N, 4, 4) in metres; the estimate is laid at the first true pose.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 6), layout="constrained")
    axes = figure.subplots()
    origin = np.linalg.inv(truth[0])
    for poses, colour, label in ((origin @ truth, TRUTH, "ground truth"), (estimate, ESTIMATE, "estimate")):
        x, y, _ = poses_to_planar(poses).T
        # Driving up the page, left turns to the left.
        axes.plot(-y, x, color=colour, label=label, linewidth=1.5)
    axes.plot(0, 0, "k^", label="start")
    axes.set(title=title, xlabel="right of the start (m)", ylabel="ahead of the start (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def motion_figure(title: str, truth: FloatArray, estimate: FloatArray) -> "Figure":
    """Rotation and translation of every frame, estimate over truth (paper fig. 5).

    Args:
        title: above the axes.
        truth, estimate: motions (N, 2) in metres and radians.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(2, 1, sharex=True)
    labels = ("heading change (degrees)", "distance (m)")
    for axes, column, label in zip(panels, (1, 0), labels, strict=True):
        for motions, colour, name in ((truth, TRUTH, "ground truth"), (estimate, ESTIMATE, "estimate")):
            values = motions[:, column]
            axes.plot(np.rad2deg(values) if column else values, color=colour, label=name, linewidth=0.9)
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    panels[0].legend(loc="upper right")
    panels[1].set_xlabel("frame")
    return figure
