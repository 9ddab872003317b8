"""Sections with a row for each setting and method: drift, the paper's beside it, errors of a frame."""

from collections.abc import Iterable, Sequence

from rcnn_odom.evaluation.scores import percent
from rcnn_odom.evaluation.sweep_report import paper
from rcnn_odom.evaluation.sweep_report.folders import Run
from rcnn_odom.evaluation.sweep_report.runs_table import Sweep
from rcnn_odom.evaluation.sweep_report.scores import Scores
from rcnn_odom.evaluation.sweep_report.statistics import mean_sd
from rcnn_odom.evaluation.sweep_report.tables import DASH, Row, code, escape, markdown_table, number, spread


def drift_table(sweep: Sweep) -> tuple[Row, list[Row]]:
    """Header and rows of the comparison table: settings, reference methods, baselines, the floor."""
    header = ["drift in %", "seeds", "validation", *sweep.sequences, "mean", "rotation deg/m", "ms a frame"]
    most = max(map(len, sweep.by_setting.values()))
    rows = []
    for setting, runs in sweep.by_setting.items():
        seeds = f"{len(runs)}" if len(runs) == most else f"{len(runs)} (fewer)"
        rows.append(_drift_row(sweep, sweep.label(setting), seeds, _scores(runs.values())))
    for name, scores in reference_methods(sweep).items():
        rows.append(_drift_row(sweep, name, DASH, scores))
    floors = _drift_cells(sweep, "floor", _scores(sweep.finished))
    rows.append(["floor of two-number motion", DASH, DASH, *floors, DASH, DASH])
    return header, rows


def _scores(runs: Iterable[Run]) -> list[Scores]:
    return [run.metrics.scores for run in runs]


def reference_methods(sweep: Sweep) -> dict[str, list[Scores]]:
    """Scores of evaluations by name and folder, then of the baselines as each run has them."""
    methods: dict[str, list[Scores]] = {}
    for run in sweep.evaluations:
        methods[f"{run.metrics.variant} ({run.name})"] = [run.metrics.scores]
    for run in sweep.finished:
        for name, scores in run.metrics.baselines.items():
            methods.setdefault(name, []).append(scores)
    return methods


def _drift_row(sweep: Sweep, label: str, seeds: str, scores: Sequence[Scores]) -> Row:
    validation = _spread([one.get("val_drift") for one in scores], 100)
    rotation = _spread([one["rotation_deg_per_m"] for one in scores], 1, 4)
    cells = [validation, *_drift_cells(sweep, "drift", scores), rotation, number(_latency(scores))]
    return [label, seeds, *cells]


def _drift_cells(sweep: Sweep, kind: str, scores: Sequence[Scores]) -> list[str]:
    """``drift`` or ``floor`` of each test sequence and their mean, in percent."""
    keys = [*(f"{kind}_{name}" for name in sweep.sequences), kind]
    return [_spread([one.get(key) for one in scores], 100) for key in keys]


def _latency(scores: Sequence[Scores]) -> float | None:
    """Of the fastest seed, in milliseconds: other jobs on a machine only ever slow it."""
    return min((one["latency_ms"] for one in scores if one.get("latency_ms") is not None), default=None)


def _spread(values: Sequence[float | None], scale: float, digits: int = 2) -> str:
    """Mean and deviation of what is known; without a deviation where all are the same."""
    known = [scale * value for value in values if value is not None]
    mean, sd = mean_sd(known)
    return spread(mean, sd if sd is None or max(known) - min(known) > 1e-9 else None, digits)


def drift_section(sweep: Sweep, figure: str) -> str:
    """The comparison table and how to read it."""
    header, rows = drift_table(sweep)
    lines = [
        "## Drift",
        markdown_table(header, rows),
        "Mean ± standard deviation over seeds (sample, divisor n-1); without one where there is one seed, or "
        "all are the same. The mean column gives every test sequence the same weight. The time of a frame is "
        "the fastest seed's median, as other jobs on the machine only ever slow it.",
    ]
    if any("(fewer)" in row[1] for row in rows):
        lines.append("**(fewer)**: fewer seeds than the others have; its mean is not over the same seeds.")
    if sweep.evaluations:
        lines.append("Methods with a folder in brackets were scored by `evaluate.py`.")
    if sweep.left_out:
        lines.append(f"Left out, as scored on other drives: {', '.join(map(code, sweep.left_out))}.")
    return "\n\n".join([*lines, figure])


def paper_section(sweep: Sweep) -> str:
    """The paper's table II beside ours, and what it claims of the swept options; empty for other drives."""
    claims = [paper.CLAIMS[option] for option in sweep.options if option in paper.CLAIMS]
    parts = ["## The paper", *claims]
    if sweep.sequences == paper.SEQUENCES:
        names = [*paper.SEQUENCES, "mean"]
        header = ["drift in %", *(f"ours, {name}" for name in names), "ours, s a frame"]
        header += [f"paper, {name}" for name in names] + ["paper, s a frame"]
        data = escape(sweep.finished[0].metrics.data)
        ours = (
            f"Ours are on `data={data}`" if data == "kitti" else f"Ours are on {data} drives, not on KITTI's"
        )
        parts += [
            markdown_table(header, _paper_rows(sweep)),
            paper.TABLE_NOTE,
            f"{ours}: for orientation only.",
        ]
    return "\n\n".join(parts) if len(parts) > 1 else ""


def _paper_rows(sweep: Sweep) -> list[Row]:
    rows: list[Row] = []
    left = dict(paper.VARIANTS)
    for setting, runs in sweep.by_setting.items():
        variants = {run.metrics.variant for run in runs.values()}
        column = paper.VARIANTS.get(variants.pop()) if len(variants) == 1 else None
        if column is None or not all(paper.is_its_network(run.settings) for run in runs.values()):
            continue
        left = {name: other for name, other in left.items() if other is not column}
        scores = _scores(runs.values())
        latency = _latency(scores)
        seconds = number(None if latency is None else latency / 1000, 4)
        cells = _drift_cells(sweep, "drift", scores)
        rows.append([sweep.label(setting), *cells, seconds, *_paper_cells(column)])
    for column in (*left.values(), *paper.COMPARED_METHODS):
        rows.append([column.name, *[DASH] * 4, *_paper_cells(column)])
    return rows


def _paper_cells(column: paper.PaperColumn) -> list[str]:
    return [*(percent(drift) for drift in column.drift.values()), number(column.seconds, 3)]


def frame_section(sweep: Sweep) -> str:
    """Errors of single frames, by setting and method."""
    kinds = ("distance_{}_m", "heading_{}_deg")
    keys = [kind.format(name) for kind in kinds for name in ("mae", "bias", "max")]
    header = ["error of a frame", *(f"distance m, {name}" for name in ("mean abs", "signed", "largest"))]
    header += [f"heading deg, {name}" for name in ("mean abs", "signed", "largest")]
    methods = {sweep.label(setting): _scores(runs.values()) for setting, runs in sweep.by_setting.items()}
    rows = []
    for label, scores in (methods | reference_methods(sweep)).items():
        cells = [_frame_cell(key, [one[key] for one in scores]) for key in keys]
        rows.append([label, *cells])
    lines = [
        "## Errors of a frame",
        markdown_table(header, rows),
        "Mean absolute and mean signed errors over all motions of the test sequences, then the mean over "
        "seeds; the largest error of any seed.",
    ]
    is_papers = sweep.sequences == paper.SEQUENCES
    return "\n\n".join([*lines, paper.FRAME_ERRORS_NOTE] if is_papers else lines)


def _frame_cell(key: str, values: Sequence[float]) -> str:
    if not values:
        return DASH
    if "_max_" in key:
        return number(max(values), 3)
    mean = mean_sd(values)[0]
    return f"{mean:+.4f}" if "_bias_" in key else number(mean, 4)
