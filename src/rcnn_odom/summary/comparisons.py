"""Which settings a report compares, and what comes out."""

from collections.abc import Mapping
from dataclasses import dataclass

from rcnn_odom.summary.options import Values
from rcnn_odom.summary.runs_table import Sweep
from rcnn_odom.summary.statistics import Ratio, holm, mean_sd, paired_ratio, verdict


@dataclass(frozen=True)
class Comparison:
    """One setting against another.

    Attributes:
        setting: whose drift is divided.
        against: by whose drift.
        ratio: of their drifts.
        adjusted_p: the ratio's p value, adjusted for all comparisons of the table.
        verdict: in words.
    """

    setting: Values
    against: Values
    ratio: Ratio
    adjusted_p: float | None
    verdict: str


def drifts_by_setting(sweep: Sweep) -> dict[Values, dict[int, float]]:
    """The mean test drift (ratio) of the runs that count, by setting and seed; those that have one."""
    return {
        setting: {
            seed: drift
            for seed, run in runs.items()
            if (drift := run.scores()["drift"]) is not None and drift > 0
        }
        for setting, runs in sweep.counting().items()
    }


def ranked(drifts: Mapping[Values, Mapping[int, float]]) -> list[Values]:
    """Settings with a drift, the lowest mean first."""
    means = {setting: mean_sd(list(runs.values()))[0] for setting, runs in drifts.items()}
    scored = {setting: mean for setting, mean in means.items() if mean is not None}
    return sorted(scored, key=lambda setting: scored[setting])


def compare(drifts: Mapping[Values, Mapping[int, float]], reference: Values) -> list[Comparison]:
    """Each setting against the reference, and the best against the second best, if that is not among them.

    The best two are chosen by the very drifts that are compared. As neighbours in the ranking they are the
    closest of all pairs, so this choice makes it harder, not easier, to show a difference.

    Args:
        drifts: by setting and seed.
        reference: one of the settings.

    Returns:
        The comparisons, all in one family for Holm's adjustment.
    """
    pairs = [(setting, reference) for setting in drifts if setting != reference]
    best = ranked(drifts)[:2]
    if len(best) == 2 and reference not in best:
        pairs.append((best[0], best[1]))
    ratios = [paired_ratio(drifts[setting], drifts[against]) for setting, against in pairs]
    adjusted = holm([ratio.p for ratio in ratios])
    return [
        Comparison(*pair, ratio, p, verdict(ratio, p))
        for pair, ratio, p in zip(pairs, ratios, adjusted, strict=True)
    ]
