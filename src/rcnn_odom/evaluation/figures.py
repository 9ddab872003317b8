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
PATH_COLOURS = ("#3b1fa8", "#0a7fd0", "#009e73", "#e08a00", "#c8102e")
"""Of a path from its start to its end; none is pale on white, and no two are alike in print."""
NUMBERS_ON_PATH = 7
"""Times that are written along a path at most."""


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


def map_figure(
    poses: FloatArray, points: list[npt.NDArray[np.float32]], times: FloatArray, clock: str = "seconds"
) -> "Figure":
    """Scans laid where they were taken, seen from above, and the path, coloured by time.

    The darker a place, the more beams it returned. Where walls are thin lines the poses agree with each
    other; where they are doubled or blurred, not.

    Args:
        poses: x, y and heading of the scans, (N, 3).
        points: of each scan (P, 2), in the frame of the poses, metres.
        times: of the scans, (N,).
        clock: what the times are.
    """
    places = np.concatenate([*points, poses[:, :2]]) @ ((0, 1), (-1, 0))  # driving up the page
    low, high = places.min(0), places.max(0)
    width, height = np.maximum(high - low, 1.0).tolist()
    scale = 5.2 / max(width, height)
    figure, axes = new_figure(max(5.4, 0.9 + scale * width), max(3.4, 1.6 + scale * height))
    _draw_returns(axes, places[: -len(poses)], low, high)
    path = places[-len(poses) :]
    for place, marker, label in ((path[0], "^", "start"), (path[-1], "X", "end")):
        axes.plot(*place, marker, color="black", markersize=9, label=label, zorder=4)
    _draw_path_by_time(axes, path, times, clock)
    axes.set(xlabel="right of the start (m)", ylabel="ahead of the start (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return figure


def _draw_returns(axes: "Axes", places: FloatArray, low: FloatArray, high: FloatArray) -> None:
    """Returns (P, 2) between two corners in metres, darker where there are more."""
    from matplotlib.colors import LogNorm

    # As many cells as the picture has dots, so that a wall is as thin as it can be shown.
    cell = max(0.05, float((high - low).max()) / 1000)
    cells = np.maximum(1, np.ceil((high - low) / cell)).astype(int).tolist()
    limits = [(float(start), float(start + count * cell)) for start, count in zip(low, cells, strict=True)]
    counts, *_ = np.histogram2d(places[:, 0], places[:, 1], bins=cells, range=limits)
    if counts.any():
        axes.imshow(
            np.ma.masked_equal(counts.T, 0),
            cmap="Greys",
            norm=LogNorm(0.5, counts.max()),
            origin="lower",
            extent=(*limits[0], *limits[1]),
        )
    axes.plot([], [], "s", color="0.3", markersize=4, label="returns of the laser")


def _draw_path_by_time(axes: "Axes", path: FloatArray, times: FloatArray, clock: str) -> None:
    """A path (N, 2) in metres, its colour telling the time (N,), with a scale and numbers along it."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.patheffects import withStroke
    from matplotlib.ticker import MaxNLocator

    colours = LinearSegmentedColormap.from_list("time", PATH_COLOURS)
    ends = np.stack([path[:-1], path[1:]], axis=1)
    pieces = LineCollection(list(ends), cmap=colours, linewidths=2, capstyle="round")
    pieces.set_array(times[1:])
    pieces.set_clim(times[0], max(times[-1], times[0] + 1e-9))
    axes.add_collection(pieces)
    axes.figure.colorbar(pieces, ax=axes, location="bottom", label=clock, aspect=40, shrink=0.9, pad=0.02)
    near, written = 0.03 * max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())), [path[0], path[-1]]
    for time in MaxNLocator(NUMBERS_ON_PATH).tick_values(times[0], times[-1]):
        place = path[min(int(np.searchsorted(times, time)), len(path) - 1)]
        if all(np.hypot(*(place - other)) > near for other in written):
            written.append(place)
            axes.plot(*place, "o", color="black", markersize=3.5, zorder=3)
            axes.annotate(
                f"{time:g}",
                place,
                (4, 4),
                textcoords="offset points",
                fontsize=9,
                path_effects=[withStroke(linewidth=2.5, foreground="white")],
            )
