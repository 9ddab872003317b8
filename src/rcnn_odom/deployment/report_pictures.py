"""The pictures of a run's report: the map, and curves over time. Drawing them needs matplotlib."""

import io
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from rcnn_odom.deployment.timeline import Stretch, Timeline
from rcnn_odom.evaluation.figures import map_figure, new_figure
from rcnn_odom.geometry import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#1c1f23"
COLOURS = ("#e69f00", "#56b4e9", "#cc79a7", "#009e73", "#d55e00", "#0072b2", "#f0e442")
"""Colours of causes, by Okabe and Ito: people with any colour vision can distinguish them from each other and
from the black lines."""
OTHER_CAUSES = "#999999"
NARROWEST = 0.004
"""Minimum width of a stretch, as a part of the time axis, so that a single scan is visible."""
WIDTH = 5.6
"""Width of a plot in inches, small enough that its text is readable on a phone."""
DOTS, IMAGE_COLOURS = 150, 96
"""Dots per inch, and number of colours to which a picture is reduced."""
LOG, FROM_ZERO = "log", "from zero"
"""Scales of a panel."""
LEAST_RATIO = 20.0
"""Ratio of the largest to the smallest value above which a panel with the scale ``LOG`` is logarithmic."""


class MapScan(NamedTuple):
    """One scan of the map.

    Attributes:
        pose: x, y in metres and heading in radians.
        points: (P, 2) metres, in the frame of the first pose.
        scan: its number.
        seconds: of the recording, 0 before its first stamp.
    """

    pose: tuple[float, float, float]
    points: npt.NDArray[np.float32]
    scan: int
    seconds: float


class Picture(NamedTuple):
    """A picture of the report.

    Attributes:
        heading: text above it.
        caption: text below it, which explains it; without markup.
        alt: description for people who cannot see it.
        draw: draws it.
    """

    heading: str
    caption: str
    alt: str
    draw: Callable[[], "Figure"]


class Panel(NamedTuple):
    """Curves over time with the same unit.

    Attributes:
        label: quantity and unit.
        curves: by name, (M,) each.
        scale: ``LOG``, ``FROM_ZERO``, or empty.
    """

    label: str
    curves: dict[str, FloatArray]
    scale: str = ""


def make_pictures(timeline: Timeline, map_scans: Sequence[MapScan], path: str) -> Iterator[Picture]:
    """All pictures of a run.

    Args:
        timeline: of the run.
        map_scans: some of its scans, in order, for the map.
        path: the line that describes the path.
    """
    yield _map_picture(timeline, map_scans, path)
    if timeline.seconds is not None:
        yield from _motion_pictures(timeline)
    yield from _deviation_pictures(timeline)


def as_png(figure: "Figure") -> bytes:
    """The content of a PNG file with few colours, a third of the size of one with all colours."""
    from PIL import Image  # installed with matplotlib, which needs it for its own PNG files

    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DOTS)
    Image.open(drawn).convert("RGB").quantize(IMAGE_COLOURS).save(small, "png", optimize=True)
    return small.getvalue()


def assign_colours(causes: Sequence[str]) -> dict[str, str]:
    """Colours by cause, for causes in order of frequency; after the seventh, all have the same colour."""
    return {
        cause: COLOURS[place] if place < len(COLOURS) else OTHER_CAUSES for place, cause in enumerate(causes)
    }


def _time_label(timeline: Timeline) -> str:
    return "number of the scan" if timeline.seconds is None else "seconds of the recording"


def _map_picture(timeline: Timeline, map_scans: Sequence[MapScan], path: str) -> Picture:
    end, no_points = timeline.end, np.empty((0, 2), np.float32)
    # The last scan may not be in the sample, so its pose is added.
    last = MapScan((end.x, end.y, end.heading), no_points, timeline.scans, timeline.seconds or 0.0)
    map_scans = [*map_scans, last]
    poses, times = np.array([one.pose for one in map_scans]), _scan_times(timeline, map_scans)
    caption = (
        "Scans at their estimated poses, seen from above; the direction ahead at the start is up. Thin walls "
        "mean that the poses agree with each other; doubled or blurred walls mean that they do not. Numbers "
        f"along the path: {_time_label(timeline)}."
    )
    points = [one.points for one in map_scans]
    return Picture(
        "Map and path",
        caption,
        f"Map with the path from its start to its end: {path}.",
        lambda: map_figure(poses, points, times, _time_label(timeline)),
    )


def _motion_pictures(timeline: Timeline) -> Iterator[Picture]:
    speed, turn_rate = timeline.curves.column("speed"), np.rad2deg(timeline.curves.column("turn_rate"))
    yield _time_picture(
        timeline,
        "Speed",
        "Computed from the estimated poses over one second each.",
        f"Speed over time: {_format_range(speed, 'm/s')}.",
        [Panel("speed (m/s)", {"": speed}, FROM_ZERO)],
    )
    yield _time_picture(
        timeline,
        "Turn rate",
        "Computed from the estimated poses over one second each; positive values are turns to the left.",
        f"Turn rate over time: {_format_range(turn_rate, 'degrees/s')}.",
        [Panel("turn rate (\N{DEGREE SIGN}/s)", {"": turn_rate})],
    )


def _deviation_pictures(timeline: Timeline) -> Iterator[Picture]:
    yield _deviation_picture(
        timeline,
        "Deviation of each step",
        "One standard deviation (1 sigma) of the motion from scan to scan, as the model estimates it: two "
        "thirds of the errors should be smaller.",
        "",
    )
    yield _deviation_picture(
        timeline,
        "Accumulated deviation",
        "One standard deviation (1 sigma) of the pose in the frame of the start, accumulated over all steps "
        "so far. Odometry does not recognise places that it has seen before, so errors are never removed.",
        "pose_",
    )


def _deviation_picture(timeline: Timeline, heading: str, caption: str, prefix: str) -> Picture:
    """Deviations of x and y in one panel, of the heading in another."""
    x, y, turn = (timeline.curves.column(f"{prefix}{name}") for name in ("x", "y", "heading"))
    turn = np.rad2deg(turn)
    known = np.flatnonzero(np.isfinite(x))
    if not len(known):
        caption += " The model does not estimate the deviation of x."
    elif prefix and known[-1] < len(x) - 1:
        caption += " The curve ends at a step of unknown deviation."
    scale = "" if prefix else LOG
    return _time_picture(
        timeline,
        heading,
        caption,
        f"{heading} over time: x {_format_range(x, 'm')}, y {_format_range(y, 'm')}, "
        f"heading {_format_range(turn, 'degrees')}.",
        [
            Panel("1 sigma, position (m)", {"x, ahead": x, "y, to the left": y}, scale),
            Panel("1 sigma, heading (\N{DEGREE SIGN})", {"": turn}, scale),
        ],
    )


def _format_range(values: FloatArray, unit: str) -> str:
    """The smallest and the largest value of a curve, in words."""
    known = values[np.isfinite(values)]
    return f"{known.min():.3g} to {known.max():.3g} {unit}" if len(known) else "unknown"


def _time_picture(
    timeline: Timeline, heading: str, caption: str, alt: str, panels: Sequence[Panel]
) -> Picture:
    """Curves over time, with the marked stretches behind them."""
    if timeline.marks.stretches:
        caption += " Coloured areas are marked stretches, each cause at its own height; see the table below."
    return Picture(heading, caption, alt, lambda: _time_figure(timeline, panels))


def _scan_times(timeline: Timeline, map_scans: Sequence[MapScan]) -> FloatArray:
    """Times of the scans in seconds, or their numbers without a clock."""
    return np.array([one.scan if timeline.seconds is None else one.seconds for one in map_scans], dtype=float)


def _time_figure(timeline: Timeline, panels: Sequence[Panel]) -> "Figure":
    has_clock = timeline.seconds is not None
    times = timeline.curves.column("seconds" if has_clock else "scan")
    height = 0.6 + 2.0 * len(panels)
    figure, rows = new_figure(WIDTH, height, nrows=len(panels), sharex=True, squeeze=False)
    for axes, panel in zip(rows[:, 0], panels, strict=True):
        for style, (name, values) in zip(("-", ":"), panel.curves.items(), strict=False):
            axes.plot(times, values, style, color=INK, linewidth=1.1, label=name or None)
        axes.set_ylabel(panel.label)
        axes.grid(alpha=0.3)
        known = times[np.isfinite(times)]  # scans before the first stamp have no time
        margin = 0.02 * max(known[-1] - known[0], 1e-3)
        axes.set_xlim(known[0] - margin, known[-1] + margin)  # the same if a curve begins later
        _set_scale(axes, panel)
        _shade_stretches(axes, timeline, has_clock)
    rows[-1, 0].set_xlabel(_time_label(timeline))
    handles, labels = rows[0, 0].get_legend_handles_labels()
    if labels:
        figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
    return figure


def _set_scale(axes: "Axes", panel: Panel) -> None:
    """Sets the scale of a panel; a logarithmic one is labelled with decimal numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter

    if panel.scale == FROM_ZERO:
        axes.set_ylim(bottom=0)
    known = np.concatenate(list(panel.curves.values()))
    known = known[known > 0]
    if panel.scale == LOG and len(known) and known.max() > LEAST_RATIO * known.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())


def _shade_stretches(axes: "Axes", timeline: Timeline, has_clock: bool) -> None:
    """Shades the marked stretches, each cause at its own height, and names the causes in the legend."""
    start, end = axes.get_xlim()
    colours = assign_colours(list(timeline.marks.counts()))
    for lane, (cause, colour) in enumerate(colours.items()):
        heights = {"ymin": 1 - (lane + 1) / len(colours), "ymax": 1 - lane / len(colours)}
        label = cause
        for one in timeline.marks.stretches[cause]:
            span = _time_span(one, has_clock, NARROWEST * (end - start))
            if span:
                axes.axvspan(*span, color=colour, alpha=0.7, linewidth=0, label=label, **heights)
                label = ""
    axes.set_xlim(start, end)


def _time_span(one: Stretch, has_clock: bool, least: float) -> tuple[float, float] | None:
    """Start and end of a stretch on the time axis, at least ``least`` apart; None before the first stamp."""
    low, high = (one.start, one.end) if has_clock else (float(one.first), float(one.last))
    if low is None or high is None:
        return None
    widening = max(0.0, least - (high - low)) / 2
    return low - widening, high + widening
