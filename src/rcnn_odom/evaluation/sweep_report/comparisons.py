"""Which settings a report compares, what comes out, and how the report says it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.scores import percent
from rcnn_odom.evaluation.sweep_report.document import DASH, Row, escape, markdown_table, number
from rcnn_odom.evaluation.sweep_report.options import Values, matches, parse_choice
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
"""Ratios by setting and seed."""


@dataclass(frozen=True)
class Comparison:
    """One setting against the reference.

    Attributes:
        setting: whose test drift is divided by the reference's.
        ratio: of their drifts.
        adjusted_p: the ratio's p value, adjusted for all comparisons of the table.
        verdict: in words.
    """

    setting: Values
    ratio: Ratio
    adjusted_p: float | None
    verdict: str


def drifts_by_setting(sweep: Sweep, score: str = "drift") -> Drifts:
    """The mean test drift of the runs that count, those that have one; with ``val_drift`` validation's."""
    return {
        setting: {seed: drift for seed, run in runs.items() if (drift := run.metrics.scores[score])}
        for setting, runs in sweep.by_setting.items()
    }


def reference_setting(sweep: Sweep, wanted: Sequence[str] = ()) -> tuple[Values, str]:
    """The setting that the others are compared with, and in words why it is this one.

    Args:
        sweep: with at least one setting.
        wanted: ``KEY=VALUE`` of swept options that single it out; without any it is the first setting with
            the paper's network, if that was swept, else the first; of those that have a drift.

    Raises:
        InputError: no setting has these values, or several have.
    """
    if wanted:
        return _chosen(sweep, wanted), "chosen by --reference"
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


def _chosen(sweep: Sweep, wanted: Sequence[str]) -> Values:
    pairs = [parse_choice(text) for text in wanted]
    short = {option.rsplit(".", 1)[-1]: option for option in sweep.options}
    found = []
    for setting in sweep.by_setting:
        values = dict(zip(sweep.options, setting, strict=True))
        if all(matches(values, short.get(key, key), value) for key, value in pairs):
            found.append(setting)
    if len(found) != 1:
        several = "several settings have it" if found else "no setting has it"
        have = "; ".join(map(sweep.label, found or sweep.by_setting))
        raise InputError(f"--reference {' '.join(wanted)}: {several}: {have}")
    return found[0]


def compare(drifts: Mapping[Values, Mapping[int, float]], reference: Values) -> list[Comparison]:
    """Each setting against the reference, all in one family for Holm's adjustment.

    Args:
        drifts: by setting and seed.
        reference: one of the settings.
    """
    others = [setting for setting in drifts if setting != reference]
    ratios = [paired_ratio(drifts[setting], drifts[reference]) for setting in others]
    adjusted = holm([ratio.p for ratio in ratios])
    return [
        Comparison(setting, ratio, p, verdict(ratio, p))
        for setting, ratio, p in zip(others, ratios, adjusted, strict=True)
    ]


def result(sweep: Sweep, reference: Values, comparisons: Sequence[Comparison]) -> str:
    """The outcome in some sentences; what is best is decided by validation, never by the test sequences."""
    if not comparisons:
        return "There is one setting, and nothing to compare it with."
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
        return " ".join([*lines, "No setting has two seeds, and one seed shows no difference."])
    if best == reference:
        lines.append("It is the reference.")
    against = escape(sweep.label(reference))
    lines += [
        f"Against the reference, {against}: {one.verdict}." for one in comparisons if one.setting == best
    ]
    shown = sum(one.verdict in ("lower drift", "higher drift") for one in comparisons)
    lines.append(f"Shown to differ from the reference in test drift: {shown} of {len(comparisons)}.")
    return " ".join(lines)


def _has_repeats(sweep: Sweep) -> bool:
    return any(len(runs) > 1 for runs in sweep.by_setting.values())


def difference_section(sweep: Sweep, reference: Values, why: str, comparisons: Sequence[Comparison]) -> str:
    """Comparisons with intervals and verdicts, and what they mean; empty without a repeated setting."""
    if not comparisons or not _has_repeats(sweep):
        return ""
    label = escape(sweep.label(reference))
    header = ["setting", "verdict", "seeds", "ratio", f"{LEVEL:.0%} interval", "p", "p (Holm)"]
    lines = [
        "## Differences",
        f"In test drift, against the reference **{label}** ({escape(why)}).",
        markdown_table(header, [_difference_row(sweep, one) for one in comparisons], words=2),
        "Ratio: drift of the setting over that of the reference, 0.90 is a tenth less. It is the geometric "
        "mean over the seeds that both have, with the interval and p of a t test on the logarithms, paired "
        f"by seed. A difference counts as shown when p, adjusted by Holm's method for {len(comparisons)} "
        f"comparison{'s' * (len(comparisons) > 1)}, is below {1 - LEVEL:.2f}; the interval is not adjusted. "
        f"*{NO_DIFFERENCE.capitalize()}* does not mean equal: the wider the interval, the less is known.",
        "Seeds vary initial weights and the order of batches; training and test drives are the same in every "
        "run, so all this speaks of these drives only.",
    ]
    if any(one.verdict == NO_DIFFERENCE and (one.ratio.p or 0) < 1 - LEVEL for one in comparisons):
        lines.append(
            f"An interval that leaves out 1 beside *{NO_DIFFERENCE}* would count if it had been the only "
            "comparison; one among several can come about by chance."
        )
    if len(sweep.options) > 1:
        lines.append("Several options were swept: a comparison is one of whole combinations.")
    return "\n\n".join(lines)


def _difference_row(sweep: Sweep, comparison: Comparison) -> Row:
    ratio = comparison.ratio
    interval = DASH if ratio.low is None else f"{number(ratio.low)} to {number(ratio.high)}"
    p_values = [number(ratio.p, 3), number(comparison.adjusted_p, 3)]
    label = sweep.label(comparison.setting)
    return [label, comparison.verdict, str(ratio.seeds), number(ratio.ratio), interval, *p_values]
