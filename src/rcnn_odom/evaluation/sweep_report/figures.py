"""The figures of the report, and the sections that consist of figures."""

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.figures import draw_trajectory, new_figure
from rcnn_odom.evaluation.scores import percent
from rcnn_odom.evaluation.sweep_report.document import MARK, code, escape, image
from rcnn_odom.evaluation.sweep_report.folders import Run
from rcnn_odom.evaluation.sweep_report.runs_table import Sweep
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.trajectory import file_name, flatten, read_kitti

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#56b4e9", "#e69f00")
"""Okabe and Ito's colours, distinct for all kinds of colour vision; without yellow, too pale on white."""
MARKERS = "osD^vPX*"

MAX_BANDS = 4
"""Largest number of settings whose scatter is drawn as bands; more bands would hide each other."""

MIN_SEGMENTS = 3
"""Smallest number of segments for a point of a curve, as in KITTI's devkit."""


def curves_section(sweep: Sweep, figures: dict[str, bytes]) -> str:
    """The section on drift against segment length; empty if no run has enough segments.

    Args:
        sweep: the runs.
        figures: contents of the PNG files by name; the figure of this section is added.
    """
    curves = {
        sweep.label(setting): found
        for setting, runs in sweep.by_setting.items()
        if (found := [curve for run in runs.values() if len(curve := length_curve(run))])
    }
    if not curves:
        return ""
    figures["length"] = png(curves_figure(curves))
    return "\n\n".join(
        [
            "## Drift against length",
            image("length", "translation and rotation error against the length of the segment"),
            "Means over the segments of all sequences. A line is the mean over seeds. With up to "
            f"{MAX_BANDS} settings, a band extends from the lowest to the highest seed. Each point has at "
            f"least {MIN_SEGMENTS} segments.",
        ]
    )


def length_curve(run: Run) -> FloatArray:
    """Errors by segment length, (P, 3): metres, translation error in percent, rotation error in deg/m."""
    rows = [
        (length, 100 * t_err, r_err)
        for length, (segments, t_err, r_err) in sorted(run.metrics.by_length.items())
        if segments >= MIN_SEGMENTS
    ]
    return np.array(rows).reshape(-1, 3)


def trajectories_section(sweep: Sweep, figures: dict[str, bytes]) -> str:
    """The section with the trajectories of one run of each setting; empty if there is no run.

    Args:
        sweep: the runs.
        figures: contents of the PNG files by name; the figures of this section are added.
    """
    lines = []
    for place, (setting, runs) in enumerate(sweep.by_setting.items(), start=1):
        if not runs:
            continue
        run = median_run(list(runs.values()))
        drift = percent(run.metrics.scores["drift"])
        title = f"{sweep.label(setting)}, seed {run.settings['seed']}, mean drift {drift} %"
        try:
            panels = {
                f"{name}: drift {percent(run.metrics.scores[f'drift_{name}'])} %": trajectory(run, name)
                for name in run.metrics.sequences
            }
        except InputError as error:
            lines.append(f"The trajectories of {code(run.name)} are missing: {escape(error)}")
            continue
        figures[f"trajectories_{place}"] = png(trajectories_figure(title, panels))
        lines.append(f"{escape(title)} ({code(run.name)}):")
        lines.append(image(f"trajectories_{place}", "estimated and true trajectories, seen from above"))
    words = "For each setting, the run with the median validation drift; the test drift has no influence."
    return "\n\n".join(["## Trajectories", words, *lines]) if lines else ""


def median_run(runs: Sequence[Run]) -> Run:
    """The run with the median validation drift (the better of two in the middle), or any if none has one."""
    drifts = {run: run.metrics.scores["val_drift"] for run in runs}
    known = sorted((run for run in runs if drifts[run] is not None), key=drifts.__getitem__) or runs
    return known[(len(known) - 1) // 2]


def trajectory(run: Run, sequence: str) -> tuple[FloatArray, FloatArray]:
    """Reads the true and the estimated positions, (N, 2) metres to the right and ahead of the start.

    Raises:
        InputError: a file is missing or does not contain a trajectory.
    """
    names = (f"{file_name(sequence)}_truth.txt", f"{file_name(sequence)}.txt")
    truth, estimate = (flatten(read_kitti(run.folder / "trajectories" / name)) for name in names)
    truth, estimate = (np.linalg.inv(poses[0]) @ poses for poses in (truth, estimate))
    return truth[:, [0, 2], 3], estimate[:, [0, 2], 3]


def png(figure: "Figure") -> bytes:
    """Converts a figure to the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": MARK})
    return buffer.getvalue()


def drift_figure(drifts: Mapping[str, Mapping[int, float]]) -> "Figure":
    """The mean test drift of every run, and the mean of each setting.

    Args:
        drifts: drifts (ratios) by the label of the setting and then by seed; the row of a setting without a
            run stays empty.
    """
    figure, axes = new_figure(8, 1.4 + 0.45 * len(drifts))
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
    axes.set_yticks(range(len(drifts)), list(map(_escape_math, drifts)))
    axes.set_xlim(left=0)
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    return figure


def curves_figure(curves: Mapping[str, Sequence[FloatArray]]) -> "Figure":
    """Translation and rotation error against the length of a segment, a line for each setting.

    Args:
        curves: by the label of the setting, the curves of its seeds from :func:`length_curve`.
    """
    figure, panels = new_figure(11, 4.4 + 0.18 * max(0, len(curves) - 3), ncols=2)
    for index, (label, runs) in enumerate(curves.items()):
        rows = np.concatenate(runs)
        lengths = np.unique(rows[:, 0])
        for column, axes in enumerate(panels, start=1):
            seeds = [rows[rows[:, 0] == length, column] for length in lengths]
            axes.plot(
                lengths, list(map(np.mean, seeds)), label=_escape_math(label), linewidth=1.6, **_style(index)
            )
            if len(curves) <= MAX_BANDS:
                low, high = list(map(np.min, seeds)), list(map(np.max, seeds))
                axes.fill_between(lengths, low, high, color=_style(index)["color"], alpha=0.13, linewidth=0)
    for axes, name in zip(
        panels, ("translation error (%)", "rotation error (degrees per metre)"), strict=True
    ):
        axes.set(xlabel="length of the segment (m)", ylabel=name)
        axes.grid(alpha=0.3)
        axes.set_ylim(bottom=0)
    columns = max(1, min(len(curves), 4, 120 // (max(map(len, curves)) + 8)))  # as many as fit in one row
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    return figure


def trajectories_figure(title: str, panels: Mapping[str, tuple[FloatArray, FloatArray]]) -> "Figure":
    """Estimated and true trajectories of one run, with a panel for each sequence.

    Args:
        title: above all panels.
        panels: true and estimated positions, see :func:`trajectory`, by the title of the panel.
    """
    figure, axes = new_figure(max(4.6 * len(panels), 7), 4.6, ncols=len(panels), squeeze=False)
    figure.suptitle(_escape_math(title), fontweight="bold")
    for panel, (name, pair) in zip(axes[0], panels.items(), strict=True):
        draw_trajectory(panel, *pair)
        panel.set_title(_escape_math(name))
    return figure


def _escape_math(text: str) -> str:
    """Escapes dollar signs, with which matplotlib starts a formula."""
    return text.replace("$", r"\$")


def _style(index: int) -> dict[str, Any]:
    """Colour and marker of a curve; the numbers of both have no common divisor, so that pairs repeat late."""
    return {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)]}
