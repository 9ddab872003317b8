"""Reads the runs of a sweep and makes a table of them."""

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
    same_drives,
    select_runs,
    setting_of,
    show_value,
    swept_options,
)
from rcnn_odom.evaluation.sweep_report.paper import VARIANTS

if TYPE_CHECKING:
    import pandas as pd

MISSING = "the last command of the sweep should have made this folder, but it does not exist"
"""Problem of a missing run. Runs that only earlier commands should have made are not known."""


@dataclass(frozen=True)
class Sweep:
    """The runs below a folder, read once.

    Attributes:
        directory: the folder.
        runs: all trainings, finished or not.
        missing: names of the run folders that the last command of the sweep should have made and that do not
            exist.
        evaluations: finished evaluations by ``evaluate.py`` on the same drives.
        left_out: names of the evaluations on other drives.
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
        """The finished runs by setting and then by seed; settings without a finished run are empty.

        Several runs with the same setting and seed are the same training, so only one of them counts: the
        first that did not take its weights from another run.
        """
        order = dict.fromkeys(setting_of(run, self.options) for run in self.runs if run.settings)
        by_setting: dict[Values, dict[int, Run]] = {setting: {} for setting in _sort_settings(order)}
        for run in sorted(self.finished, key=lambda run: bool(run.metrics.scores["same_as"])):
            by_setting[setting_of(run, self.options)].setdefault(run.settings["seed"], run)
        return by_setting

    def label(self, setting: Values) -> str:
        """Label of a setting, for instance ``rcnn_reg, kernel_size=5``; the variant if nothing was swept."""
        if not self.options:
            variants = (run.settings.get("model.variant") for run in self.runs if run.settings)
            return ", ".join(dict.fromkeys(map(show_value, variants)))
        names = [option.rsplit(".", 1)[-1] for option in self.options]
        parts = []
        for option, name, value in zip(self.options, names, setting, strict=True):
            key = option if names.count(name) > 1 else name
            parts.append(show_value(value) if option == "model.variant" else f"{key}={show_value(value)}")
        return ", ".join(parts)


def _sort_settings(settings: Iterable[Values]) -> list[Values]:
    """Sorts settings: numbers by value, variants as in the paper, other texts by first appearance."""
    places = {setting: place for place, setting in enumerate(settings)}
    first = {value: place for setting, place in reversed(places.items()) for value in setting}
    first |= {variant: place for place, variant in enumerate(VARIANTS)}

    def sort_key(setting: Values) -> list[tuple[int, float]]:
        numbers = [isinstance(value, int | float) and not isinstance(value, bool) for value in setting]
        return [
            (0, value) if number else (1, first[value])
            for value, number in zip(setting, numbers, strict=True)
        ]

    return sorted(places, key=sort_key)


def read_sweep(
    directory: str | Path, only: Sequence[str] = (), expected: Sequence[str] | None = None
) -> Sweep:
    """Reads the runs below a folder; they may come from several sweeps.

    Args:
        directory: the folder of a sweep, or any folder that contains runs.
        only: texts ``KEY=VALUE`` with the full names of options; only runs with these values are read.
        expected: names of the run folders that the last command of the folder should have made; None if they
            are not known.

    Raises:
        InputError: there is no such folder, it contains no run, or the runs have different data, so that one
            table cannot compare them.
    """
    directory = Path(directory)
    all_runs = find_runs(directory)
    found = select_runs(all_runs, only)
    runs = [run for run in found if not run.is_evaluation]
    if not runs:
        hint = ", only evaluations of other runs" if found else ""
        raise InputError(
            f"{directory}: no run in it{hint}; train some, for instance rcnn-odom train -m seed=0,1,2"
        )
    folders = {run.name for run in all_runs}
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
    """Reads the runs below a folder as a table with one row for each run, finished or not.

    The table has these columns; a value that is not known is None or nan:

    - ``run``: path of the run below the folder; ``status``: ``finished``, ``unfinished``, ``failed``,
      ``damaged`` or ``missing`` (the last command of the folder should have made the run, but it does not
      exist); ``problem``: why the run is not finished.
    - ``variant``, ``seed``, ``data``.
    - a column for each swept option with its full name (``model.kernel_size``), lists as tuples.
      ``attrs["options"]`` of the table contains these names.
    - ``drift``: mean over the test sequences, a ratio; ``drift_NAME`` for each sequence; ``floor``: drift of
      the true steps reduced to two numbers; ``val_drift``: drift on the validation sequences.
    - every other metric over all test sequences under its name (see
      :func:`rcnn_odom.evaluation.metrics.all_metrics`): ``rotation_deg_per_m``, ``distance_mae_m`` ...
    - ``latency_ms``: median time per frame; ``seconds``: training time; ``first_stage_seconds``: training
      time of the first stage of a recurrent network, if the run trained it itself.
    - ``same_as``: the run that did the same training before and whose weights were taken.
    - ``repeats``: the run of this table that has the same setting and seed and counts instead.

    Evaluations by ``evaluate.py`` are not runs and not in the table.

    Args:
        directory: the folder of a sweep, or any folder that contains runs, for instance ``outputs``.
        only: texts ``KEY=VALUE``; only runs with these values are in the table.
        expected: names of the run folders that should exist, for the status ``missing``; see
            :func:`rcnn_odom.training.sweep.expected_folders` for the folder of a sweep.

    Raises:
        InputError: there is no such folder, it contains no run, or the runs have different data.
    """
    return runs_table(read_sweep(directory, only, expected))


def runs_table(sweep: Sweep) -> "pd.DataFrame":
    """Makes the table of :func:`load_runs` from runs that are already read."""
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
