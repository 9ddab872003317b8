"""The report's figures."""

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rcnn_odom.evaluation.figures import ESTIMATE, TRUTH
from rcnn_odom.evaluation.sweep_report.curves import SLOW, Curve
from rcnn_odom.geometry import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#56b4e9", "#e69f00")
"""Okabe and Ito's, which people with any colour vision tell apart; without yellow, pale on white."""
MARKERS = "osD^vPX*"

MOST_BANDS = 4
"""Settings up to which their scatter is drawn; of more the bands would hide each other."""

MARK = "rcnn-odom report"
"""Written into every file of a report, by which it is known as one."""


def png(figure: "Figure") -> bytes:
    """A figure as the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": MARK})
    return buffer.getvalue()


def drift_figure(drifts: Mapping[str, Mapping[int, float]]) -> "Figure":
    """The mean test drift of every run, and of each setting the mean.

    Args:
        drifts: ratio by seed, by the label of the setting; settings without a run show nothing.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 1.4 + 0.45 * len(drifts)), layout="constrained")
    axes = figure.subplots()
    seeds = sorted({seed for runs in drifts.values() for seed in runs})
    for place, runs in enumerate(drifts.values()):
        if runs:
            mean = 100 * np.mean(list(runs.values()))
            axes.plot([mean, mean], [place - 0.3, place + 0.3], color="black", linewidth=2.5, zorder=1)
    for index, seed in enumerate(seeds):
        points = [(100 * runs[seed], place) for place, runs in enumerate(drifts.values()) if seed in runs]
        axes.plot(*zip(*points, strict=True), linestyle="", label=f"seed {seed}", alpha=0.85, **_style(index))
    axes.plot([], [], color="black", linewidth=2.5, label="mean")
    axes.set(xlabel="mean drift of the test sequences (%)", ylim=(len(drifts) - 0.5, -0.5))
    axes.set_yticks(range(len(drifts)), list(map(_plain, drifts)))
    axes.set_xlim(left=0)
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    return figure


def curves_figure(curves: Mapping[str, Sequence[Curve]], over: str) -> "Figure":
    """Translation and rotation error against the length or the speed of a segment, a line for each setting.

    Args:
        curves: of the seeds, by the label of the setting.
        over: ``length`` or ``speed``, which is given in km/h for cars.
    """
    from matplotlib.figure import Figure

    fastest = max(np.max(curve.x, initial=0.0) for runs in curves.values() for curve in runs)
    unit, scale = ("m", 1.0) if over == "length" else ("km/h", 3.6) if fastest > SLOW else ("m/s", 1.0)
    figure = Figure(figsize=(11, 4.4 + 0.18 * max(0, len(curves) - 3)), layout="constrained")
    panels: list[Axes] = list(figure.subplots(1, 2))
    for axes, label in zip(
        panels, ("translation error (%)", "rotation error (degrees per metre)"), strict=True
    ):
        axes.set(xlabel=f"{over} of the segment ({unit})", ylabel=label)
        axes.grid(alpha=0.3)
    for index, (label, runs) in enumerate(curves.items()):
        for axes, values in zip(panels, _over_seeds(runs), strict=True):
            x, middle, low, high = values
            axes.plot(scale * x, middle, label=_plain(label), linewidth=1.6, **_style(index))
            if len(curves) <= MOST_BANDS:
                axes.fill_between(scale * x, low, high, color=_style(index)["color"], alpha=0.13, linewidth=0)
    for axes in panels:
        axes.set_ylim(bottom=0)
    columns = 1 if max(map(len, curves)) > 40 else min(len(curves), 4)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    return figure


def _over_seeds(runs: Sequence[Curve]) -> FloatArray:
    """Of translation (%) and rotation: places, and mean, least and largest over the seeds; (2, 4, P)."""
    places = np.unique(np.concatenate([run.x for run in runs]))
    result = np.empty((2, 4, len(places)))
    for column, place in enumerate(places):
        here = [(run, np.isclose(run.x, place)) for run in runs]
        translation = np.concatenate([100 * run.t_err[at] for run, at in here])
        rotation = np.concatenate([run.r_err_deg_per_m[at] for run, at in here])
        for row, values in enumerate((translation, rotation)):
            result[row, :, column] = place, values.mean(), values.min(), values.max()
    return result


def _plain(text: str) -> str:
    """Text in which a dollar sign begins no formula."""
    return text.replace("$", r"\$")


def _style(index: int) -> dict[str, Any]:
    """Colours and markers with numbers of elements that share no divisor, so that few pairs repeat."""
    return {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)]}


def trajectories_figure(
    rows: Mapping[str, Mapping[str, tuple[FloatArray, FloatArray]]],
) -> "Figure":
    """Trajectories over the truth, a row for each run and a column for each sequence.

    Args:
        rows: true and estimated planar camera poses (N, 4, 4) by the panel's title, by the row's title.
    """
    from matplotlib.figure import Figure

    columns = max(map(len, rows.values()))
    figure = Figure(figsize=(max(4.6 * columns, 7), 4.6 * len(rows)), layout="constrained")
    parts = figure.subfigures(len(rows), squeeze=False)[:, 0]
    for part, (title, panels) in zip(parts, rows.items(), strict=True):
        part.suptitle(_plain(title), fontweight="bold")
        for axes, (name, pair) in zip(np.ravel(part.subplots(1, len(panels))), panels.items(), strict=True):
            _draw_trajectory(axes, name, *pair)
    return figure


def _draw_trajectory(axes: "Axes", title: str, truth: FloatArray, estimate: FloatArray) -> None:
    """Both from the same first pose, x to the right and z up the page."""
    for poses, colour, label in ((truth, TRUTH, "ground truth"), (estimate, ESTIMATE, "estimate")):
        relative = np.linalg.inv(poses[0]) @ poses
        axes.plot(relative[:, 0, 3], relative[:, 2, 3], color=colour, label=label, linewidth=1.4)
    axes.plot(0, 0, "k^", label="start")
    axes.set(title=_plain(title), xlabel="right of the start (m)", ylabel="ahead of the start (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
