"""How a report begins: what was swept, which runs are not finished, and the outcome."""

from collections.abc import Sequence
from datetime import datetime

from rcnn_odom.summary.comparisons import Comparison, drifts_by_setting, ranked
from rcnn_odom.summary.options import Values, show_value
from rcnn_odom.summary.runs_table import Sweep
from rcnn_odom.summary.statistics import NO_DIFFERENCE, mean_sd
from rcnn_odom.summary.tables import code, escape, percent


def opening(sweep: Sweep, now: datetime) -> str:
    """Title, what was swept, how the runs ended, and a warning with every run that is not finished."""
    counts = {"finished": len(sweep.finished)}
    for status in ("failed", "unfinished", "damaged"):
        counts[status] = sum(run.status == status for run in sweep.runs)
    counts["missing"] = len(sweep.missing)
    told = ", ".join(f"{count} {status}" for status, count in counts.items() if count or status == "finished")
    lines = [
        f"# Runs in {code(sweep.directory.resolve().name)}",
        f"Written on {now:%Y-%m-%d at %H:%M}. Of {len(sweep.runs) + len(sweep.missing)} runs: {told}.",
        _problems(sweep),
        _swept(sweep),
    ]
    return "\n\n".join(filter(None, lines))


def _problems(sweep: Sweep) -> str:
    problems = []
    for run in sweep.runs:
        if run.status != "finished":
            # A sweep's folders are named by what their runs set.
            options = [override for override in run.overrides if override not in run.name]
            which = f" ({escape(', '.join(options))})" if options else ""
            problems.append(f"> - **{run.status}** {code(run.name)}{which}: {escape(run.problem)}")
    problems += [
        f"> - **missing** {code(name)}: asked for, and there is no such folder" for name in sweep.missing
    ]
    if not problems:
        return ""
    advice = (
        "> No mean below contains them. Repeat the sweep's command to run what is not finished, "
        "then make this report again."
    )
    count = f"{len(problems)} run{'s are' if len(problems) > 1 else ' is'}"
    return "\n".join([f"> **Warning: {count} not finished.**", ">", *problems, ">", advice])


def _swept(sweep: Sweep) -> str:
    rows = []
    for place, option in enumerate(sweep.options):
        values = dict.fromkeys(show_value(setting[place]) for setting in sweep.counting())
        rows.append(f"- {code(option)}: {', '.join(map(code, values))}")
    seeds = sorted({run.settings["seed"] for run in sweep.runs if run.settings})
    rows.append(f"- {code('seed')}: {', '.join(map(str, seeds))}")
    first = next((run for run in sweep.runs if run.settings), None)
    name = first.settings.get("data.name") if first else None
    data = f"Tested on {', '.join(map(escape, sweep.sequences))} of {code(f'data={name}')}."
    return "\n".join(["Swept:", "", *rows, "", data])


def result(sweep: Sweep, reference: Values, comparisons: Sequence[Comparison]) -> str:
    """The outcome in a sentence or two."""
    drifts = drifts_by_setting(sweep)
    order = ranked(drifts)
    if len(order) < 2:
        return ""
    values = list(drifts[order[0]].values())
    seeds = f"{len(values)} seeds" if len(values) > 1 else "one seed"
    best = escape(sweep.label(order[0]))
    lines = [f"Lowest mean drift: **{best}**, {percent(mean_sd(values)[0])} % over {seeds}."]
    for comparison in comparisons:
        if {comparison.setting, comparison.against} == {order[0], order[1]}:
            words = _best_against_next(comparison, comparison.setting == order[0])
            lines.append(f"Against the next, {escape(sweep.label(order[1]))}, {words}.")
    shown = sum(
        one.verdict in ("lower drift", "higher drift") for one in comparisons if one.against == reference
    )
    others = sum(one.against == reference for one in comparisons)
    count = (
        f"{shown or 'none'} of the {others} others"
        if others > 1
        else ("the other" if shown else "not the other")
    )
    lines.append(f"Shown to differ from {escape(sweep.label(reference))}: {count}.")
    return " ".join(lines)


def _best_against_next(comparison: Comparison, best_comes_first: bool) -> str:
    if comparison.verdict == NO_DIFFERENCE:
        return "no difference is shown"
    if comparison.adjusted_p is None:
        return "so few seeds say nothing"
    if (comparison.verdict == "lower drift") == best_comes_first:
        return "a lower drift is shown"
    # Means are over all seeds of a setting, and comparisons over those that both have.
    return "over the seeds that both have a higher drift is shown"
