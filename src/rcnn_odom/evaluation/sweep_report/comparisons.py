"""Compares the settings of a sweep with a reference, and describes the result in the report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.scores import percent
from rcnn_odom.evaluation.sweep_report.document import DASH, Row, escape, markdown_table, number
from rcnn_odom.evaluation.sweep_report.options import Values, has_value, parse_choice
from rcnn_odom.evaluation.sweep_report.paper import NETWORK
from rcnn_odom.evaluation.sweep_report.runs_table import Sweep
from rcnn_odom.evaluation.sweep_report.statistics import (
    LEVEL,
    NO_DIFFERENCE,
    Ratio,
    holm,
    paired_ratio,
    verdict,
)

Drifts = dict[Values, dict[int, float]]
"""Drifts (ratios) by setting and then by seed."""


@dataclass(frozen=True)
class Comparison:
    """The comparison of one setting with the reference.

    Attributes:
        setting: the setting.
        ratio: its test drift divided by that of the reference.
        adjusted_p: p value of the ratio, adjusted for all comparisons of the table; None if nothing could
            be tested.
        verdict: the result in words.
    """

    setting: Values
    ratio: Ratio
    adjusted_p: float | None
    verdict: str


def drifts_by_setting(sweep: Sweep, score: str = "drift") -> Drifts:
    """The drifts of the finished runs by setting and seed; runs without this score are left out.

    Args:
        sweep: the runs.
        score: ``drift``, the mean over the test sequences, or ``val_drift``, that of validation.
    """
    return {
        setting: {seed: drift for seed, run in runs.items() if (drift := run.metrics.scores[score])}
        for setting, runs in sweep.by_setting.items()
    }


def reference_setting(sweep: Sweep, wanted: Sequence[str] = ()) -> tuple[Values, str]:
    """Chooses the setting that the others are compared with.

    Args:
        sweep: a sweep with at least one setting.
        wanted: texts ``KEY=VALUE`` of swept options that match exactly one setting. Without any, the
            reference is the first setting with a drift that has the paper's network (if the sweep varies the
            network), otherwise the first setting with a drift.

    Returns:
        The setting, and in words why it was chosen.

    Raises:
        InputError: no setting, or more than one, has the wanted values.
    """
    if wanted:
        return _find_setting(sweep, wanted), "chosen by --reference"
    settings = list(sweep.by_setting)
    swept = NETWORK.keys() & sweep.options
    papers = [
        setting
        for setting in settings
        if swept and all(dict(zip(sweep.options, setting, strict=True))[key] == NETWORK[key] for key in swept)
    ]
    drifts = drifts_by_setting(sweep)
    order = [*papers, *settings]
    reference = next((setting for setting in order if drifts[setting]), order[0])
    return reference, "the paper's choice" if reference in papers else "the first that has a drift"


def _find_setting(sweep: Sweep, wanted: Sequence[str]) -> Values:
    """The only setting that has all wanted values; raises InputError if there is none, or more than one."""
    pairs = [parse_choice(text) for text in wanted]
    short = {option.rsplit(".", 1)[-1]: option for option in sweep.options}
    found = []
    for setting in sweep.by_setting:
        values = dict(zip(sweep.options, setting, strict=True))
        if all(has_value(values, short.get(key, key), value) for key, value in pairs):
            found.append(setting)
    if len(found) != 1:
        several = "several settings have it" if found else "no setting has it"
        have = "; ".join(map(sweep.label, found or sweep.by_setting))
        raise InputError(f"--reference {' '.join(wanted)}: {several}: {have}")
    return found[0]


def compare_settings(drifts: Mapping[Values, Mapping[int, float]], reference: Values) -> list[Comparison]:
    """Compares each setting with the reference; Holm's adjustment takes all comparisons together.

    Args:
        drifts: drifts (ratios) by setting and seed.
        reference: one of the settings.
    """
    others = [setting for setting in drifts if setting != reference]
    ratios = [paired_ratio(drifts[setting], drifts[reference]) for setting in others]
    adjusted = holm([ratio.p for ratio in ratios])
    return [
        Comparison(setting, ratio, p, verdict(ratio, p))
        for setting, ratio, p in zip(others, ratios, adjusted, strict=True)
    ]


def result_text(sweep: Sweep, reference: Values, comparisons: Sequence[Comparison]) -> str:
    """Describes the result in a few sentences; validation chooses the best setting, not the test drift."""
    if not comparisons:
        return "There is only one setting, so there is nothing to compare."
    validation, test = drifts_by_setting(sweep, "val_drift"), drifts_by_setting(sweep)
    means = {setting: fmean(runs.values()) for setting, runs in validation.items() if runs}
    best = min(means, key=lambda setting: means[setting], default=None)
    lines = []
    if best is not None:
        seeds = f"{len(validation[best])} seeds" if len(validation[best]) > 1 else "one seed"
        drift = f"{percent(fmean(test[best].values()))} %" if test[best] else "not known"
        lines.append(
            f"Lowest mean validation drift: **{escape(sweep.label(best))}**, {percent(means[best])} % over "
            f"{seeds}. Its mean test drift is {drift}."
        )
    if not _has_repeats(sweep):
        return " ".join([*lines, "No setting has two seeds, and one seed cannot show a difference."])
    if best == reference:
        lines.append("It is the reference.")
    against = escape(sweep.label(reference))
    lines += [
        f"Compared with the reference, {against}: {each.verdict}."
        for each in comparisons
        if each.setting == best
    ]
    shown = sum(each.verdict in ("lower drift", "higher drift") for each in comparisons)
    lines.append(
        f"A difference from the reference in test drift is shown for {shown} of {len(comparisons)} settings."
    )
    return " ".join(lines)


def _has_repeats(sweep: Sweep) -> bool:
    return any(len(runs) > 1 for runs in sweep.by_setting.values())


def difference_section(sweep: Sweep, reference: Values, why: str, comparisons: Sequence[Comparison]) -> str:
    """The table of comparisons with intervals and verdicts, explained; empty if no setting has two seeds."""
    if not comparisons or not _has_repeats(sweep):
        return ""
    label = escape(sweep.label(reference))
    header = ["setting", "verdict", "seeds", "ratio", f"{LEVEL:.0%} interval", "p", "p (Holm)"]
    lines = [
        "## Differences",
        f"Differences in test drift from the reference **{label}** ({escape(why)}).",
        markdown_table(header, [_difference_row(sweep, each) for each in comparisons], words=2),
        "The ratio is the drift of the setting divided by that of the reference; 0.90 is a tenth less. It is "
        "the geometric mean over the common seeds. The interval and p come from a t test on the logarithms, "
        f"paired by seed. A difference is shown if p, adjusted by Holm's method for {len(comparisons)} "
        f"comparison{'s' * (len(comparisons) > 1)}, is below {1 - LEVEL:.2f}; the interval is not adjusted. "
        f"*{NO_DIFFERENCE.capitalize()}* does not mean equal: the wider the interval, the less is known.",
        "Seeds vary the initial weights and the order of batches. The training and test drives are the same "
        "in every run, so these results are valid only for these drives.",
    ]
    if any(each.verdict == NO_DIFFERENCE and (each.ratio.p or 0) < 1 - LEVEL for each in comparisons):
        lines.append(
            f"Some intervals with *{NO_DIFFERENCE}* exclude 1. With a single comparison such an interval "
            "would show a difference, but among several comparisons it can occur by chance."
        )
    if len(sweep.options) > 1:
        lines.append(
            "Several options were swept, so each comparison is between whole combinations of their values."
        )
    return "\n\n".join(lines)


def _difference_row(sweep: Sweep, comparison: Comparison) -> Row:
    ratio = comparison.ratio
    interval = DASH if ratio.low is None else f"{number(ratio.low)} to {number(ratio.high)}"
    p_values = [number(ratio.p, 3), number(comparison.adjusted_p, 3)]
    label = sweep.label(comparison.setting)
    return [label, comparison.verdict, str(ratio.seeds), number(ratio.ratio), interval, *p_values]
