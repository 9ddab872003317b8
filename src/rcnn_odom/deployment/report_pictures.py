"""The pictures of a run's page: the map, and what happened over time. Drawing them needs matplotlib."""

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
"""Of causes, by Okabe and Ito, whom people with any colour vision tell apart; lines are black."""
OTHER_CAUSES = "#999999"
NARROWEST = 0.004
"""Part of the time axis that a stretch is drawn wide at least, so that a single scan is seen."""
WIDTH = 5.6
"""Inches of a plot, few enough that its words can be read on a phone."""
DOTS, IMAGE_COLOURS = 150, 96
"""Dots per inch, and colours that a picture is reduced to."""
LOG, FROM_ZERO = "log", "from zero"
"""Scales of a panel."""
LEAST_RATIO = 20.0
"""Between the values of a panel, from which on a logarithmic scale is used."""


class Seen(NamedTuple):
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
    """A picture of the page.

    Attributes:
        heading: above it.
        caption: below it, what it shows; plain text.
        alt: what is to be seen, for those who do not see it.
        draw: makes it.
    """

    heading: str
    caption: str
    alt: str
    draw: Callable[[], "Figure"]


class Panel(NamedTuple):
    """Curves over time that share a unit.

    Attributes:
        label: what they are, and the unit.
        curves: by name, (M,) each.
        scale: ``LOG``, ``FROM_ZERO``, or empty.
    """

    label: str
    curves: dict[str, FloatArray]
    scale: str = ""


def pictures_of(timeline: Timeline, seen: Sequence[Seen], path: str) -> Iterator[Picture]:
    """All pictures of a run.

    Args:
        timeline: of the run.
        seen: some of its scans, in order, for the map.
        path: the line that tells of the path.
    """
    yield _map(timeline, seen, path)
    if timeline.seconds is not None:
        yield from _motion(timeline)
    yield from _deviations(timeline)


def as_png(figure: "Figure") -> bytes:
    """A figure as the content of a PNG file, in few colours: a third of the size."""
    from PIL import Image  # of matplotlib, which needs it for its own PNG files

    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DOTS)
    Image.open(drawn).convert("RGB").quantize(IMAGE_COLOURS).save(small, "png", optimize=True)
    return small.getvalue()


def colours_of(causes: Sequence[str]) -> dict[str, str]:
    """Those of causes, the most frequent first; later ones share one."""
    return {
        cause: COLOURS[place] if place < len(COLOURS) else OTHER_CAUSES for place, cause in enumerate(causes)
    }


def _clock(timeline: Timeline) -> str:
    return "number of the scan" if timeline.seconds is None else "seconds of the recording"


def _map(timeline: Timeline, seen: Sequence[Seen], path: str) -> Picture:
    end, nothing = timeline.end, np.empty((0, 2), np.float32)
    # The last scan need not be among them.
    seen = [*seen, Seen((end.x, end.y, end.heading), nothing, timeline.scans, timeline.seconds or 0.0)]
    poses, times = np.array([one.pose for one in seen]), _times_of(timeline, seen)
    caption = (
        "The scans laid where they were taken, seen from above; at the start it looks up the page. Thin "
        "walls mean poses that agree with each other; doubled or blurred walls mean poses that do not. The "
        f"numbers along the path are {_clock(timeline)}."
    )
    points = [one.points for one in seen]
    return Picture(
        "Map and path",
        caption,
        f"Map with the path from its start to its end: {path}.",
        lambda: map_figure(poses, points, times, _clock(timeline)),
    )


def _motion(timeline: Timeline) -> Iterator[Picture]:
    speed, turn_rate = timeline.curves.column("speed"), np.rad2deg(timeline.curves.column("turn_rate"))
    yield _picture(
        timeline,
        "Speed",
        "Of the estimated poses, over one second each.",
        f"Speed over time: {_range(speed, 'm/s')}.",
        [Panel("speed (m/s)", {"": speed}, FROM_ZERO)],
    )
    yield _picture(
        timeline,
        "Turn rate",
        "Of the estimated poses, over one second each; to the left where positive.",
        f"Turn rate over time: {_range(turn_rate, 'degrees/s')}.",
        [Panel("turn rate (\N{DEGREE SIGN}/s)", {"": turn_rate})],
    )


def _deviations(timeline: Timeline) -> Iterator[Picture]:
    yield _deviation(
        timeline,
        "Deviation of each step",
        "One standard deviation (1 sigma) of the motion from scan to scan, as the model estimates it: two "
        "thirds of the errors should be smaller.",
        "",
    )
    yield _deviation(
        timeline,
        "Accumulated deviation",
        "One standard deviation (1 sigma) of the pose in the frame of the start, from those of all steps "
        "before. Odometry does not notice when it comes back to a place, so that nothing takes errors away.",
        "pose_",
    )


def _deviation(timeline: Timeline, heading: str, caption: str, prefix: str) -> Picture:
    """Deviations of x and y in one panel, of the heading in another."""
    x, y, turn = (timeline.curves.column(f"{prefix}{name}") for name in ("x", "y", "heading"))
    turn = np.rad2deg(turn)
    known = np.flatnonzero(np.isfinite(x))
    if not len(known):
        caption += " The model does not tell that of x."
    elif prefix and known[-1] < len(x) - 1:
        caption += " Where the curve ends a step came of which it is unknown."
    scale = "" if prefix else LOG
    return _picture(
        timeline,
        heading,
        caption,
        f"{heading} over time: x {_range(x, 'm')}, y {_range(y, 'm')}, heading {_range(turn, 'degrees')}.",
        [
            Panel("1 sigma, place (m)", {"x, ahead": x, "y, to the left": y}, scale),
            Panel("1 sigma, heading (\N{DEGREE SIGN})", {"": turn}, scale),
        ],
    )


def _range(values: FloatArray, unit: str) -> str:
    """Between which values a curve lies, in words."""
    known = values[np.isfinite(values)]
    return f"{known.min():.3g} to {known.max():.3g} {unit}" if len(known) else "unknown"


def _picture(timeline: Timeline, heading: str, caption: str, alt: str, panels: Sequence[Panel]) -> Picture:
    """Curves over time with the marked stretches behind them."""
    if timeline.marks.stretches:
        caption += " Coloured stretches are marked, each cause at a height of its own; see the table below."
    return Picture(heading, caption, alt, lambda: _time_figure(timeline, panels))


def _times_of(timeline: Timeline, seen: Sequence[Seen]) -> FloatArray:
    """When the scans were taken: seconds, or their numbers where there is no clock."""
    return np.array([one.scan if timeline.seconds is None else one.seconds for one in seen], dtype=float)


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
        known = times[np.isfinite(times)]  # scans before the first stamp have none
        margin = 0.02 * max(known[-1] - known[0], 1e-3)
        axes.set_xlim(known[0] - margin, known[-1] + margin)  # also where a curve begins later
        _set_scale(axes, panel)
        _shade(axes, timeline, has_clock)
    rows[-1, 0].set_xlabel(_clock(timeline))
    handles, labels = rows[0, 0].get_legend_handles_labels()
    if labels:
        figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
    return figure


def _set_scale(axes: "Axes", panel: Panel) -> None:
    """The panel's scale; a logarithmic one with plain numbers."""
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


def _shade(axes: "Axes", timeline: Timeline, has_clock: bool) -> None:
    """The marked stretches, each cause at a height of its own, and in the legend what they are."""
    start, end = axes.get_xlim()
    colours = colours_of(list(timeline.marks.counts()))
    for lane, (cause, colour) in enumerate(colours.items()):
        heights = {"ymin": 1 - (lane + 1) / len(colours), "ymax": 1 - lane / len(colours)}
        label = cause
        for one in timeline.marks.stretches[cause]:
            span = _span(one, has_clock, NARROWEST * (end - start))
            if span:
                axes.axvspan(*span, color=colour, alpha=0.7, linewidth=0, label=label, **heights)
                label = ""
    axes.set_xlim(start, end)


def _span(one: Stretch, has_clock: bool, least: float) -> tuple[float, float] | None:
    """Where a stretch lies on the time axis, at least so wide; None before the first stamp."""
    low, high = (one.start, one.end) if has_clock else (float(one.first), float(one.last))
    if low is None or high is None:
        return None
    wider = max(0.0, least - (high - low)) / 2
    return low - wider, high + wider
