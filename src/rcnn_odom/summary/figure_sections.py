"""Sections with figures: drift against length and speed, and trajectories."""

from collections.abc import Mapping

from rcnn_odom.errors import InputError
from rcnn_odom.motion import FloatArray
from rcnn_odom.summary.curves import by_length, by_speed, read_curves, trajectory
from rcnn_odom.summary.document import image
from rcnn_odom.summary.folders import Run
from rcnn_odom.summary.options import setting_of
from rcnn_odom.summary.plots import MOST_BANDS, length_figure, png, speed_figure, trajectories_figure
from rcnn_odom.summary.runs_table import Sweep
from rcnn_odom.summary.tables import code, escape, percent


def curves_section(sweep: Sweep, figures: dict[str, bytes]) -> str:
    """Drift against length and speed; adds the figures."""
    segments, problems = {}, []
    for setting, runs in sweep.counting().items():
        found, missing = read_curves(list(runs.values()), sweep.sequences)
        problems += missing
        if found:
            segments[sweep.label(setting)] = found
    lengths = {label: [by_length(one) for one in runs] for label, runs in segments.items()}
    speeds = {label: [by_speed(one) for one in runs] for label, runs in segments.items()}
    lines = ["## Drift against length and speed"]
    if any(len(curve.x) for runs in lengths.values() for curve in runs):
        figures["length"] = png(length_figure(lengths))
        lines.append(image("length", "translation and rotation error against the length of the segment"))
    if any(len(curve.x) for runs in speeds.values() for curve in runs):
        figures["speed"] = png(speed_figure(speeds))
        lines.append(image("speed", "translation and rotation error against the speed over the segment"))
    if len(lines) > 1:
        lines.append(
            "Means over all segments, whatever sequence they are of. A line is the mean over seeds; a band, "
            f"drawn for up to {MOST_BANDS} settings, reaches from the lowest to the highest seed. As in "
            "KITTI's devkit, a point among the speeds takes segments up to one step of speed away, and three "
            "segments at least make a point."
        )
    lines += [f"Not drawn: {escape(problem)}" for problem in problems]
    return "\n\n".join(lines) if len(lines) > 1 else ""


def trajectories_section(sweep: Sweep, figures: dict[str, bytes]) -> str:
    """Trajectories of the best and the worst run; adds the figure."""
    drifts = {run: run.scores()["drift"] for runs in sweep.counting().values() for run in runs.values()}
    order = sorted((run for run in drifts if drifts[run] is not None), key=lambda run: drifts[run])
    if not order:
        return ""
    shown = {"best": order[0], "worst": order[-1]} if len(order) > 1 else {"only": order[0]}
    try:
        rows = {_run_title(sweep, word, run): _panels(sweep, run) for word, run in shown.items()}
    except InputError as error:
        return f"## Trajectories\n\nNot drawn: {escape(error)}"
    figures["trajectories"] = png(trajectories_figure(rows))
    names = " and ".join(f"{code(run.name)} ({word})" for word, run in shown.items())
    words = (
        f"Of the runs with the lowest and the highest mean drift, {names}: chosen after the fact, for show."
        if len(order) > 1
        else f"Of the one run that counts, {names}."
    )
    return "\n\n".join(
        [
            "## Trajectories",
            words,
            image("trajectories", "trajectories over the truth, seen from above"),
        ]
    )


def _run_title(sweep: Sweep, word: str, run: Run) -> str:
    setting, seed = sweep.label(setting_of(run, sweep.options)), run.settings["seed"]
    return f"{word} run: {setting}, seed {seed}, mean drift {percent(run.scores()['drift'])} %"


def _panels(sweep: Sweep, run: Run) -> Mapping[str, tuple[FloatArray, FloatArray]]:
    scores = run.scores()
    return {
        f"{name}: drift {percent(scores[f'drift_{name}'])} %": trajectory(run, name)
        for name in sweep.sequences
    }
