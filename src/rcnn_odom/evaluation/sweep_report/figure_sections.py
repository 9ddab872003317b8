"""Sections with figures: drift against length and speed, and trajectories."""

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.scores import percent
from rcnn_odom.evaluation.sweep_report.curves import by_length, by_speed, read_curves, trajectory
from rcnn_odom.evaluation.sweep_report.document import image
from rcnn_odom.evaluation.sweep_report.folders import Run
from rcnn_odom.evaluation.sweep_report.options import setting_of
from rcnn_odom.evaluation.sweep_report.plots import MOST_BANDS, curves_figure, png, trajectories_figure
from rcnn_odom.evaluation.sweep_report.runs_table import Sweep
from rcnn_odom.evaluation.sweep_report.tables import code, escape
from rcnn_odom.geometry import FloatArray


def curves_section(sweep: Sweep, figures: dict[str, bytes]) -> str:
    """Drift against length and speed; adds the figures."""
    segments, problems = {}, []
    for setting, runs in sweep.by_setting.items():
        found, missing = read_curves(list(runs.values()), sweep.sequences)
        problems += missing
        if found:
            segments[sweep.label(setting)] = found
    lines = ["## Drift against length and speed"]
    for over, means in (("length", by_length), ("speed", by_speed)):
        curves = {label: [means(one) for one in runs] for label, runs in segments.items()}
        if any(len(curve.x) for runs in curves.values() for curve in runs):
            figures[over] = png(curves_figure(curves, over))
            lines.append(image(over, f"translation and rotation error against the {over} of the segment"))
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
    drifts = {run: run.metrics.scores["drift"] for runs in sweep.by_setting.values() for run in runs.values()}
    order = sorted((run for run in drifts if drifts[run] is not None), key=lambda run: drifts[run])
    if not order:
        return ""
    shown = {"best": order[0], "worst": order[-1]} if len(order) > 1 else {"only": order[0]}
    try:
        rows = {_run_title(sweep, word, run): _panels(run) for word, run in shown.items()}
    except InputError as error:
        return f"## Trajectories\n\nNot drawn: {escape(error)}"
    figures["trajectories"] = png(trajectories_figure(rows))
    names = " and ".join(f"{code(run.name)} ({word})" for word, run in shown.items())
    words = f"Of {names}, by test drift: chosen after the fact, for show."
    picture = image("trajectories", "trajectories over the truth, seen from above")
    return f"## Trajectories\n\n{words}\n\n{picture}"


def _run_title(sweep: Sweep, word: str, run: Run) -> str:
    setting, seed = sweep.label(setting_of(run, sweep.options)), run.settings["seed"]
    return f"{word} run: {setting}, seed {seed}, mean drift {percent(run.metrics.scores['drift'])} %"


def _panels(run: Run) -> dict[str, tuple[FloatArray, FloatArray]]:
    drifts = {name: percent(run.metrics.scores[f"drift_{name}"]) for name in run.metrics.sequences}
    return {f"{name}: drift {drift} %": trajectory(run, name) for name, drift in drifts.items()}
