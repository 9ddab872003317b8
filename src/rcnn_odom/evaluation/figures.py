"""The figures of the paper: trajectories, and the motion of each frame."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUTH, ESTIMATE = "tab:blue", "tab:red"
"""The paper's colours."""


def new_figure(width: float, height: float, **panels: Any) -> tuple["Figure", Any]:
    """An empty figure, in inches, and its axes: what ``Figure.subplots`` makes of the panels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(**panels)


def trajectory_figure(title: str, truth: FloatArray, estimate: FloatArray) -> "Figure":
    """Estimate over truth, seen from above (paper fig. 4).

    Args:
        title: above the axes.
        truth, estimate: laser poses (N, 4, 4) in metres, each laid at its own first pose.
    """
    figure, axes = new_figure(7, 6)
    # Driving up the page, left turns to the left.
    seen = ((np.linalg.inv(poses[0]) @ poses)[:, :2, 3] @ ((0, 1), (-1, 0)) for poses in (truth, estimate))
    draw_trajectory(axes, title, *seen)
    return figure


def draw_trajectory(axes: "Axes", title: str, truth: FloatArray, estimate: FloatArray) -> None:
    """Estimate over truth, (N, 2) metres to the right and ahead of the start."""
    for way, colour, label in ((truth, TRUTH, "ground truth"), (estimate, ESTIMATE, "estimate")):
        axes.plot(*way.T, color=colour, label=label, linewidth=1.5)
    axes.plot(0, 0, "k^", label="start")
    axes.set(title=title, xlabel="right of the start (m)", ylabel="ahead of the start (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def motion_figure(title: str, truth: FloatArray, estimate: FloatArray) -> "Figure":
    """Rotation and translation of every frame, estimate over truth (paper fig. 5).

    Args:
        title: above the axes.
        truth, estimate: motions (N, 2) in metres and radians.
    """
    figure, panels = new_figure(11, 6, nrows=2, sharex=True)
    figure.suptitle(title)
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


def coverage_figure(title: str, ratios: FloatArray) -> "Figure":
    """How many errors lie within so many of their estimated standard deviations, beside normal errors.

    Args:
        title: above the axes.
        ratios: absolute errors of distance and heading over their deviations, (N, 2); nan where unknown.
    """
    from scipy.stats import halfnorm

    figure, axes = new_figure(7, 5)
    times = np.linspace(0, 4, 200)
    axes.plot(times, 100 * halfnorm.cdf(times), "k--", label="normal errors", linewidth=1)
    for column, colour, label in ((0, TRUTH, "distance"), (1, ESTIMATE, "heading")):
        known = np.sort(ratios[np.isfinite(ratios[:, column]), column])
        if len(known):
            share = np.searchsorted(known, times, side="right") / len(known)
            axes.plot(times, 100 * share, color=colour, label=label, linewidth=1.5)
    axes.set(xlabel="estimated standard deviations", ylabel="frames whose error is within them (%)")
    axes.set_title(title, fontsize="medium")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def map_figure(title: str, poses: FloatArray, points: list[npt.NDArray[np.float32]]) -> "Figure":
    """Scans laid where they were taken, seen from above: how often each place returned a beam.

    Where walls are thin lines the poses agree with each other; where they are doubled or blurred, not.

    Args:
        title: above the axes.
        poses: x, y and heading of the scans, (N, 3).
        points: of each scan (P, 2), in the frame of the poses, metres.
    """
    from matplotlib.colors import LogNorm

    figure, axes = new_figure(9, 9)
    x, y = np.concatenate(points).T
    low, high = (np.array([f(-y, initial=0), f(x, initial=0)]) for f in (np.min, np.max))
    # As many cells as the picture has dots, so that a wall is as thin as it can be shown.
    cell = max(0.05, float((high - low).max()) / 1000)
    cells = np.maximum(1, np.ceil((high - low) / cell)).astype(int)
    limits = [(low[0], low[0] + cells[0] * cell), (low[1], low[1] + cells[1] * cell)]
    counts, *_ = np.histogram2d(-y, x, bins=cells, range=limits)
    if counts.any():
        axes.imshow(
            np.ma.masked_equal(counts.T, 0),
            cmap="Greys",
            norm=LogNorm(0.5, counts.max()),
            origin="lower",
            extent=(*limits[0], *limits[1]),
        )
    axes.plot([], [], "s", color="0.3", markersize=4, label="returns, darker where more")
    axes.plot(-poses[:, 1], poses[:, 0], color=ESTIMATE, linewidth=1.2, label="estimated path")
    axes.plot(-poses[0, 1], poses[0, 0], "k^", label="start")
    axes.set(title=title, xlabel="right of the start (m)", ylabel="ahead of the start (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure
