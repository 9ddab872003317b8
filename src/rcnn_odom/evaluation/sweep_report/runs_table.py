"""The table of a sweep's runs."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.metrics import all_metrics
from rcnn_odom.evaluation.sweep_report.folders import Run, find_runs, first_stage_seconds
from rcnn_odom.evaluation.sweep_report.options import (
    Values,
    check_same_data,
    choose,
    same_drives,
    setting_of,
    show_value,
    swept_options,
)
from rcnn_odom.evaluation.sweep_report.paper import VARIANTS

if TYPE_CHECKING:
    import pandas as pd

MISSING = "the last command for this folder asked for it, and there is no such folder"
"""What is wrong with a missing run; what earlier commands asked for is not known."""


@dataclass(frozen=True)
class Sweep:
    """The runs below a folder, read once.

    Attributes:
        directory: that folder.
        runs: trainings, whatever became of them.
        missing: names of folders that the folder's last command asked for and that are not there.
        evaluations: finished ones by ``evaluate.py`` on the same drives.
        left_out: names of evaluations on other drives.
        options: full names of the swept options.
    """

    directory: Path
    runs: list[Run]
    missing: list[str]
    evaluations: list[Run]
    left_out: list[str]
    options: list[str]

    @property
    def finished(self) -> list[Run]:
        """The finished runs."""
        return [run for run in self.runs if run.status == "finished"]

    @property
    def sequences(self) -> tuple[str, ...]:
        """Names of the test sequences, the same in all finished runs."""
        return self.finished[0].metrics.sequences if self.finished else ()

    @cached_property
    def by_setting(self) -> dict[Values, dict[int, Run]]:
        """The finished runs by setting and seed; settings of which none has finished are there too.

        Where several have the same setting and seed one counts: it is one training, however often it was
        run. It is the first that did not take its weights from another.
        """
        order = dict.fromkeys(setting_of(run, self.options) for run in self.runs if run.settings)
        by_setting: dict[Values, dict[int, Run]] = {setting: {} for setting in _by_value(order)}
        for run in sorted(self.finished, key=lambda run: bool(run.metrics.scores["same_as"])):
            by_setting[setting_of(run, self.options)].setdefault(run.settings["seed"], run)
        return by_setting

    def label(self, setting: Values) -> str:
        """A setting for people, ``rcnn_reg, kernel_size=5``; the variant alone where nothing was swept."""
        if not self.options:
            variants = (run.settings.get("model.variant") for run in self.runs if run.settings)
            return ", ".join(dict.fromkeys(map(show_value, variants)))
        names = [option.rsplit(".", 1)[-1] for option in self.options]
        parts = []
        for option, name, value in zip(self.options, names, setting, strict=True):
            key = option if names.count(name) > 1 else name
            parts.append(show_value(value) if option == "model.variant" else f"{key}={show_value(value)}")
        return ", ".join(parts)


def _by_value(settings: Iterable[Values]) -> list[Values]:
    """Numbers in their order, variants in the paper's; other words in the order in which they came."""
    come = {setting: place for place, setting in enumerate(settings)}
    first = {value: place for setting, place in reversed(come.items()) for value in setting}
    first |= {variant: place for place, variant in enumerate(VARIANTS)}

    def order(setting: Values) -> list[tuple[int, float]]:
        numbers = [isinstance(value, int | float) and not isinstance(value, bool) for value in setting]
        return [
            (0, value) if number else (1, first[value])
            for value, number in zip(setting, numbers, strict=True)
        ]

    return sorted(come, key=order)


def read_sweep(
    directory: str | Path, only: Sequence[str] = (), expected: Sequence[str] | None = None
) -> Sweep:
    """Reads the runs below a folder, which need not come from one sweep.

    Args:
        directory: a sweep's folder, or any around runs.
        only: ``KEY=VALUE`` of options that a run must have to be taken, with their full names.
        expected: names of the folders that the folder's last command asked for; None where not known.

    Raises:
        InputError: no such folder, no run in it, or runs on different data, which no table can hold.
    """
    directory = Path(directory)
    everything = find_runs(directory)
    found = choose(everything, only)
    runs = [run for run in found if not run.is_evaluation]
    if not runs:
        only_scores = ", only evaluations of other runs" if found else ""
        raise InputError(
            f"{directory}: no run in it{only_scores}; train some, for instance rcnn-odom train -m seed=0,1,2"
        )
    folders = {run.name for run in everything}
    missing = [name for name in expected or () if name not in folders]
    options = swept_options([run for run in runs if run.settings])
    finished = [run for run in runs if run.status == "finished"]
    check_same_data(finished, options)
    evaluations = [run for run in found if run.is_evaluation]
    same = [run for run in evaluations if finished and same_drives(run, finished[0])]
    left_out = [run.name for run in evaluations if run not in same]
    return Sweep(directory, runs, missing, same, left_out, options)


def load_runs(
    directory: str | Path, only: Sequence[str] = (), expected: Sequence[str] | None = None
) -> "pd.DataFrame":
    """The runs below a folder as a table, one row a run, finished or not.

    Columns, empty (None or nan) where that is not known:

    - ``run``: its path below the folder; ``status``: ``finished``, ``unfinished``, ``failed``, ``damaged``,
      or ``missing`` (the folder's last command asked for it, and it is not there); ``problem``: why it is
      not finished.
    - ``variant``, ``seed``, ``data``.
    - a column for each swept option under its full name (``model.kernel_size``); lists as tuples.
      ``attrs["options"]`` of the table names them.
    - ``drift``: mean over the test sequences, a ratio; ``drift_NAME`` of each; ``floor`` of two-number
      motion; ``val_drift`` of validation.
    - every other metric over all test sequences, under its name (see
      :func:`rcnn_odom.evaluation.metrics.all_metrics`): ``rotation_deg_per_m``, ``distance_mae_m`` ...
    - ``latency_ms``: median time of a frame; ``seconds``: of training; ``first_stage_seconds``: of
      training a recurrent network's first stage, where that was done within the run.
    - ``same_as``: the run that did the same training before, and gave its weights.
    - ``repeats``: the run in this table that has the same setting and seed, and counts in its place.

    Evaluations by ``evaluate.py`` are no runs and not in the table.

    Args:
        directory: a sweep's folder, or any around runs, for instance ``outputs``.
        only: ``KEY=VALUE`` of options that a run must have to be in the table.
        expected: names of the folders that should be there, for the status ``missing``; for a sweep's folder
            :func:`rcnn_odom.training.sweep.expected_folders` knows them.

    Raises:
        InputError: no such folder, no run in it, or runs on different data.
    """
    return runs_table(read_sweep(directory, only, expected))


def runs_table(sweep: Sweep) -> "pd.DataFrame":
    """The table of :func:`load_runs` for runs that have been read."""
    import pandas as pd

    rows = [_row(sweep, run) for run in sweep.runs]
    rows += [{"run": name, "status": "missing", "problem": MISSING} for name in sweep.missing]
    numbers = ["drift", *(f"drift_{name}" for name in sweep.sequences), "floor", "val_drift"]
    numbers += [name for name in all_metrics() if name != "drift"]
    numbers += ["latency_ms", "seconds", "first_stage_seconds"]
    columns = ["run", "status", "problem", "variant", "seed", "data", *sweep.options]
    columns += [*numbers, "same_as", "repeats"]
    table = pd.DataFrame(rows, columns=columns)
    table = table.astype(dict.fromkeys(numbers, "float64") | {"seed": "Int64"})
    table.attrs["options"] = list(sweep.options)
    return table


def _row(sweep: Sweep, run: Run) -> dict[str, Any]:
    row: dict[str, Any] = {"run": run.name, "status": run.status, "problem": run.problem}
    if run.settings:
        setting = setting_of(run, sweep.options)
        row |= dict(zip(sweep.options, setting, strict=True))
        for column, option in (("variant", "model.variant"), ("data", "data.name"), ("seed", "seed")):
            row[column] = run.settings.get(option)
        if run.status == "finished":
            row |= run.metrics.scores | {"first_stage_seconds": first_stage_seconds(run)}
            counted = sweep.by_setting[setting][run.settings["seed"]]
            row["repeats"] = None if counted is run else counted.name
    return row
