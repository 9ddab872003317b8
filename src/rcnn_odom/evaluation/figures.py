"""Figures: the trajectories and frame motions of the paper, coverage of errors, and a map of scans."""

from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUTH, ESTIMATE = "tab:blue", "tab:red"
"""The colours of the paper's figures."""
PATH_COLOURS = ("#3b1fa8", "#0a7fd0", "#009e73", "#e08a00", "#c8102e")
"""Colours of a path from start to end; all are visible on white, and distinct when printed."""
WIDTH, HEIGHT, HEIGHT_OF_PANEL, DOTS_PER_INCH = 5.2, 4.5, 2.9, 180
"""Width of the figure of a run, its height, and that of each of several panels, in inches. TensorBoard shows
a figure about 350 pixels wide, so that the text of a larger one would be tiny."""
TITLE_LETTERS = 46
"""Maximum number of letters in a line of such a figure's title."""
MAX_TIME_LABELS = 7
"""Largest number of times that are written along a path."""


def new_figure(width: float, height: float, **panels: Any) -> tuple["Figure", Any]:
    """Creates an empty figure and its axes.

    Args:
        width, height: in inches.
        panels: arguments of ``Figure.subplots``.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(**panels)


def new_run_figure(title: str, panels: int = 1) -> tuple["Figure", list["Axes"]]:
    """Creates an empty figure whose text can be read in a file and in TensorBoard, and its axes.

    Args:
        title: above the first panel, broken into lines.
        panels: number of panels, one above the other, with a common horizontal axis.
    """
    height = max(HEIGHT, HEIGHT_OF_PANEL * panels)
    figure, grid = new_figure(WIDTH, height, nrows=panels, sharex=True, squeeze=False)
    figure.set_dpi(DOTS_PER_INCH)
    axes = grid[:, 0].tolist()
    axes[0].set_title(fill(title, TITLE_LETTERS), fontsize="medium")
    return figure, axes


def draw_pixels(figure: "Figure") -> npt.NDArray[np.uint8]:
    """The pixels of a figure, (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def trajectory_figure(title: str, truth: FloatArray, estimate: FloatArray) -> "Figure":
    """Estimated and true trajectory seen from above (paper fig. 4).

    Args:
        title: above the axes.
        truth, estimate: laser poses (N, 4, 4) in metres. Each trajectory is drawn in the frame of its own
            first pose.
    """
    figure, (axes,) = new_run_figure(title)
    # The robot drives up the page, and left turns go to the left.
    places = ((np.linalg.inv(poses[0]) @ poses)[:, :2, 3] @ ((0, 1), (-1, 0)) for poses in (truth, estimate))
    draw_trajectory(axes, *places)
    return figure


def draw_trajectory(axes: "Axes", truth: FloatArray, estimate: FloatArray) -> None:
    """Draws the estimated and the true trajectory, (N, 2) metres to the right and ahead of the start."""
    for path, colour, label in ((truth, TRUTH, "ground truth"), (estimate, ESTIMATE, "estimate")):
        axes.plot(*path.T, color=colour, label=label, linewidth=1.5)
    axes.plot(0, 0, "k^", label="start")
    axes.set(xlabel="right of the start (m)", ylabel="ahead of the start (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def motion_figure(title: str, truth: FloatArray, estimate: FloatArray) -> "Figure":
    """Estimated and true rotation and translation of every frame (paper fig. 5).

    Args:
        title: above the axes.
        truth, estimate: motions (N, 2), distance in metres and heading change in radians.
    """
    figure, panels = new_run_figure(title, panels=2)
    labels = ("heading change (degrees)", "distance (m)")
    for axes, column, label in zip(panels, (1, 0), labels, strict=True):
        for motions, colour, name in ((truth, TRUTH, "ground truth"), (estimate, ESTIMATE, "estimate")):
            values = motions[:, column]
            axes.plot(np.rad2deg(values) if column else values, color=colour, label=name, linewidth=0.9)
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    panels[0].legend(loc="upper right")
    panels[1].set_xlabel("number of the scan in the drive")
    return figure


def coverage_figure(title: str, ratios: FloatArray) -> "Figure":
    """Share of the errors within k estimated standard deviations, for k from 0 to 4.

    The curve of normally distributed errors is drawn for comparison.

    Args:
        title: above the axes.
        ratios: absolute errors of distance and heading divided by their estimated standard deviations,
            (N, 2); nan where the deviation is unknown.
    """
    from scipy.stats import halfnorm

    figure, (axes,) = new_run_figure(title)
    times = np.linspace(0, 4, 200)
    axes.plot(times, 100 * halfnorm.cdf(times), "k--", label="normal errors", linewidth=1)
    for column, colour, label in ((0, TRUTH, "distance"), (1, ESTIMATE, "heading")):
        known = np.sort(ratios[np.isfinite(ratios[:, column]), column])
        if len(known):
            share = np.searchsorted(known, times, side="right") / len(known)
            axes.plot(times, 100 * share, color=colour, label=label, linewidth=1.5)
    axes.set(
        xlabel="size of the error, in estimated standard deviations",
        ylabel="scans with an error up to that size (%)",
    )
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def map_figure(
    poses: FloatArray, points: list[npt.NDArray[np.float32]], times: FloatArray, clock: str = "seconds"
) -> "Figure":
    """Map of all scans at their poses, seen from above, and the path, coloured by time.

    A place is darker the more returns it has. Thin walls mean that the poses agree with each other; doubled
    or blurred walls mean that they do not.

    Args:
        poses: x and y in metres and heading in radians of the scans, (N, 3).
        points: the points of each scan, (P, 2) metres, in the frame of the poses.
        times: times of the scans, (N,).
        clock: label of the times, with their unit.
    """
    places = np.concatenate([*points, poses[:, :2]]) @ ((0, 1), (-1, 0))  # The robot drives up the page.
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
    """Draws returns (P, 2) between two corners in metres; places with more returns are darker."""
    from matplotlib.colors import LogNorm

    # One cell for each pixel of the figure, about, so that walls are as thin as possible.
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
    """Draws a path (N, 2) in metres, coloured by time (N,), with a colour bar and times along the path."""
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
    spacing, labelled = 0.03 * max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())), [path[0], path[-1]]
    for time in MaxNLocator(MAX_TIME_LABELS).tick_values(times[0], times[-1]):
        place = path[min(int(np.searchsorted(times, time)), len(path) - 1)]
        if all(np.hypot(*(place - other)) > spacing for other in labelled):
            labelled.append(place)
            axes.plot(*place, "o", color="black", markersize=3.5, zorder=3)
            axes.annotate(
                f"{time:g}",
                place,
                (4, 4),
                textcoords="offset points",
                fontsize=9,
                path_effects=[withStroke(linewidth=2.5, foreground="white")],
            )
