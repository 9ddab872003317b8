"""The section that says which differences are shown and which are not."""

from collections.abc import Sequence

from rcnn_odom.summary.comparisons import Comparison
from rcnn_odom.summary.options import Values
from rcnn_odom.summary.runs_table import Sweep
from rcnn_odom.summary.statistics import LEVEL, NO_DIFFERENCE
from rcnn_odom.summary.tables import DASH, Row, escape, markdown_table, number


def difference_section(sweep: Sweep, reference: Values, why: str, comparisons: Sequence[Comparison]) -> str:
    """Comparisons with intervals and verdicts, and what they mean."""
    if not comparisons:
        return "## Differences\n\nThere is one setting, and nothing to compare it with."
    header = ["setting", "against", "verdict", "seeds", "ratio", f"{LEVEL:.0%} interval", "p", "p (Holm)"]
    rows = [_difference_row(sweep, comparison) for comparison in comparisons]
    alone = any(
        one.ratio.p is not None and one.ratio.p < 1 - LEVEL <= (one.adjusted_p or 0) for one in comparisons
    )
    lines = [
        "## Differences",
        f"The reference is **{escape(sweep.label(reference))}** ({escape(why)}).",
        markdown_table(header, rows, words=3),
        "Ratio: drift of the setting over that of the other, 0.90 is a tenth less. It is the geometric mean "
        "over the seeds that both have, with the interval and p of a t test on the logarithms, paired by "
        f"seed. A difference counts as shown when p, adjusted by Holm's method for {len(comparisons)} "
        f"comparison{'s' * (len(comparisons) > 1)}, is below {1 - LEVEL:.2f}; the interval is not adjusted. "
        f"*{NO_DIFFERENCE.capitalize()}* does not mean equal: the wider the interval, the less is known.",
        "Seeds vary the training and not the test drives, so all this speaks of these drives only.",
    ]
    if alone:
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
    settings = [sweep.label(comparison.setting), sweep.label(comparison.against)]
    p_values = [number(ratio.p, 3), number(comparison.adjusted_p, 3)]
    return [*settings, comparison.verdict, str(ratio.seeds), number(ratio.ratio), interval, *p_values]
