"""The report as a person gets it: its files, tables, warnings, curves."""

import re
import shutil

import numpy as np
import pytest
import yaml

from rcnn_odom.cli import main
from rcnn_odom.evaluation.sweep_report.build import make_report
from rcnn_odom.evaluation.sweep_report.document import code, duration, escape, markdown_table
from rcnn_odom.evaluation.sweep_report.figures import length_curve, median_run, trajectory
from rcnn_odom.evaluation.sweep_report.folders import read_run
from rcnn_odom.recordings.trajectory import file_name
from summary_runs import begin_run, finish_run, method, write_trajectories

DRIFTS = {3: (0.20, 0.22, 0.18), 5: (0.10, 0.12, 0.09)}
VALIDATION = {3: 0.15, 5: 0.16}
"""In another order than the test drifts."""


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A sweep of two kernels and three seeds, all finished; not to be written to."""
    folder = tmp_path_factory.mktemp("outputs") / "kernel_size"
    for kernel, drifts in DRIFTS.items():
        for seed, value in enumerate(drifts):
            run = folder / f"kernel_size={kernel},seed={seed}"
            overrides = ["model=cnn_cls", f"model.kernel_size={kernel}", f"seed={seed}"]
            changes = {
                "val": {"drift": VALIDATION[kernel] + 0.01 * seed},
                "latency": {"median_ms": 4.0 + seed},
            }
            finish_run(run, overrides, {"05": value, "07": value + 0.02}, **changes)
            write_trajectories(run, 1 + value / 2, value / 100)
    return folder


@pytest.fixture
def bare(sweep):
    """The same without trajectories, of which a report is made sooner."""
    for folder in sweep.glob("*/trajectories"):
        shutil.rmtree(folder)
    return sweep


@pytest.fixture
def sweep(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "kernel_size")


def row(text, start):
    """Cells of the first row of a Markdown table that begins like this."""
    line = next(line for line in text.splitlines() if line.startswith(f"| {start} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def section(text, title):
    return text.split(f"## {title}\n")[1].split("\n## ")[0]


def test_the_tables_hold_means_and_deviations(sweep, capsys):
    before = {path: path.read_bytes() for path in sweep.rglob("*") if path.is_file()}
    assert main(["report", str(sweep)]) == 0
    output = capsys.readouterr().out
    text = (sweep / "report.md").read_text()
    # 0.20, 0.22, 0.18: mean 0.20, deviations 0, 0.02, -0.02.
    expected = [
        "kernel_size=3",
        "3",
        "16.00 ± 1.00",
        "20.00 ± 2.00",
        "22.00 ± 2.00",
        "21.00 ± 2.00",
        "4.00",
    ]
    assert row(section(text, "Drift"), "kernel_size=3") == expected
    assert row(section(text, "Drift"), "held_motion") == [
        "held_motion",
        "-",
        *["-", "50.00", "70.00", "60.00", "-"],
    ]
    assert row(section(text, "Drift"), "floor of two-number motion")[3:6] == ["0.40"] * 3
    others = section(text, "Other metrics")
    frame = ["0.2929", "-0.1464", "1.050", "0.5857", "+0.2929", "2.100"]
    # 0.11, 0.13, 0.10 over ten: mean 0.01133, deviations -0.0003, 0.0017, -0.0013.
    assert row(others, "kernel_size=5") == ["kernel_size=5", "0.0113 ± 0.0015", *frame]
    assert row(others, "held_motion")[1] == "0.0600"
    difference = row(section(text, "Differences"), "kernel_size=5")
    assert difference[1:3] == ["lower drift", "3"]
    logs = np.log([[0.11, 0.13, 0.10], [0.21, 0.23, 0.19]])
    assert difference[3] == f"{np.exp((logs[0] - logs[1]).mean()):.2f}"
    assert "Warning" not in text
    assert "Total training time: 9 min 00 s, of the 6 runs whose time is known." in text
    assert "Versions: torch 2.13.0, numpy 2.4.6." in text
    assert "kernel_size=5 3 17.00 ± 1.00 10.33 ± 1.53 12.33 ± 1.53" in " ".join(output.split())
    assert output.splitlines()[-2:] == [f"{sweep}/report.md", f"{sweep}/report.html"]
    assert {path: path.read_bytes() for path in before} == before


def test_the_paper_stands_beside_its_own_network_only(bare):
    make_report(bare)
    paper = section((bare / "report.md").read_text(), "The paper")
    assert row(paper, "kernel_size=3")[5:] == ["27.64", "7.56", "17.60", "0.005"]
    assert row(paper, "RCNN-Regression")[5:] == ["2.93", "2.18", "2.55", "0.015"]
    assert row(paper, "DeepVO (one camera)")[5:] == ["2.62", "3.91", "3.26", "1.000"]
    assert "| kernel_size=5 |" not in paper
    assert "RMSE translation drift" in paper
    assert "kernels of size 3" in paper


def test_the_page_needs_no_other_file(sweep):
    written = make_report(sweep)
    page = written.html.read_text()
    sources = re.findall(r'\b(?:src|href)\s*=\s*"([^"]*)"', page)
    assert len(sources) == 4
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert not re.search(r"https?://|file://|url\(|@import|<script|<link", page)
    assert str(sweep) not in page
    assert page.count("<table>") == 5
    figures = {path.name for path in (sweep / "report_figures").iterdir()}
    assert figures == {"drift.png", "length.png", "trajectories_1.png", "trajectories_2.png"}
    for name in figures:
        assert f"(report_figures/{name})" in written.markdown.read_text()
    assert not list(sweep.rglob("*.partial"))


def test_what_is_not_finished_comes_first_and_in_no_mean(bare, capsys):
    (bare / "kernel_size=5,seed=1" / "metrics.json").unlink()
    (bare / "kernel_size=5,seed=1" / "error.txt").write_text("a|b <img src=x> *c* `d` _e_ [f](g)\n")
    (bare / "kernel_size=5,seed=2" / "metrics.json").write_text("{")
    begin_run(bare / "<b>x|y", ["model=cnn_cls", "model.kernel_size=7", "seed=0"])
    assert main(["report", str(bare)]) == 0
    assert "runs that did not finish: 3;" in capsys.readouterr().out
    text = (bare / "report.md").read_text()
    assert "Of 7 runs: 4 finished, 1 failed, 1 unfinished, 1 damaged." in text
    warning = text[: text.index("Swept options:")]
    assert warning.count("> - **") == 3
    assert row(text, "kernel_size=5")[1:6] == ["1 (fewer)", "16.00", "10.00", "12.00", "11.00"]
    assert row(text, "kernel_size=7")[1:6] == ["0 (fewer)", "-", "-", "-", "-"]
    assert row(section(text, "Differences"), "kernel_size=5")[1] == "one seed: nothing can be tested"
    page = (bare / "report.html").read_text()
    assert "a|b &#60;img src=x&#62; &#42;c&#42;" in page.replace("&#124;", "|")
    assert "<img src=x>" not in page
    assert "<b>x" not in page
    assert "<em>c</em>" not in page


def test_equal_settings_show_no_difference(tmp_path):
    for kernel in (3, 5):
        for seed, value in enumerate((0.1, 0.2, 0.3)):
            overrides = [f"model.kernel_size={kernel}", f"seed={seed}"]
            finish_run(tmp_path / f"{kernel}-{seed}", overrides, {"05": value, "07": value})
    make_report(tmp_path)
    text = (tmp_path / "report.md").read_text()
    cells = [
        "kernel_size=5",
        "no difference shown",
        "3",
        "1.00",
        "1.00 to 1.00",
        "1.000",
        "1.000",
    ]
    assert row(section(text, "Differences"), "kernel_size=5") == cells
    assert "in test drift is shown for 0 of 1 settings." in text
    assert "The trajectories of `5-1` are missing: " in text


def test_the_best_is_told_by_validation(bare):
    make_report(bare)
    text = (bare / "report.md").read_text()
    best = "**kernel_size=3**, 16.00 % over 3 seeds. Its mean test drift is 21.00 %."
    others = (
        "It is the reference. A difference from the reference in test drift is shown for 1 of 1 settings."
    )
    assert f"Lowest mean validation drift: {best} {others}" in text
    assert "the reference **kernel_size=3** (the paper's choice)" in text
    make_report(bare, reference=["model.kernel_size=5"])
    text = (bare / "report.md").read_text()
    assert f"{best} Compared with the reference, kernel_size=5: higher drift." in text
    assert "the reference **kernel_size=5** (chosen by --reference)" in text


def test_one_seed_shows_no_difference(tmp_path):
    for beta, validation in ((1.0, 0.3), (2.0, 0.1), (3.0, 0.2)):
        drifts = {"05": beta / 10, "07": beta / 10}
        finish_run(tmp_path / f"{beta}", [f"model.beta={beta}"], drifts, val={"drift": validation})
    make_report(tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert (
        "Lowest mean validation drift: **beta=2.0**, 10.00 % over one seed. Its mean test drift is 20.00 %. "
        "No setting has two seeds, and one seed cannot show a difference." in text
    )
    assert "## Differences" not in text
    assert "reference" not in text


def test_a_reference_has_a_drift(bare):
    for folder in bare.glob("kernel_size=3,*"):
        (folder / "metrics.json").unlink()
    for seed in range(2):
        overrides = ["model=cnn_cls", "model.kernel_size=7", f"seed={seed}"]
        finish_run(bare / f"kernel_size=7,seed={seed}", overrides, {"05": 0.3, "07": 0.3})
    make_report(bare)
    text = (bare / "report.md").read_text()
    assert "the reference **kernel_size=5** (the first that has a drift)" in text
    assert row(section(text, "Differences"), "kernel_size=7")[2] == "2"


def test_the_command_is_hydras(bare):
    overrides = {
        "hydra": ["hydra/launcher=joblib", "hydra.mode=MULTIRUN"],
        "task": ["+sweeps=kernel_size", "data.val=[c[:0.5]]"],
    }
    (bare / "multirun.yaml").write_text(yaml.safe_dump({"hydra": {"overrides": overrides}}))
    make_report(bare)
    origin = section((bare / "report.md").read_text(), "Commands and versions")
    command = "rcnn-odom train -m hydra/launcher=joblib +sweeps=kernel_size 'data.val=[c[:0.5]]'"
    assert f"Last command of this folder:\n\n    {command}\n" in origin
    alone = "    rcnn-odom train model=cnn_cls model.kernel_size=5 seed=2"
    assert alone in origin.split("Commands of the single runs:\n\n")[1].splitlines()
    assert len(re.findall("    (rcnn-odom train.*)", origin)) == 1 + 6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--reference", "kernel_size=9"],
            "--reference kernel_size=9: no setting has it: kernel_size=3; kernel",
        ),
        (["--reference", "9"], "9: write KEY=VALUE"),
        (["--only", "model.kernel_size=9"], "no run has this value; they have 3, 5"),
    ],
)
def test_mistaken_choices_are_told(bare, capsys, arguments, message):
    assert main(["report", str(bare), *arguments]) == 1
    assert message in capsys.readouterr().err
    assert not (bare / "report.md").exists()


@pytest.mark.parametrize("name", ["report.md", "report.html", "report_figures/drift.png"])
def test_files_of_others_are_not_overwritten(bare, capsys, name):
    make_report(bare)
    (bare / name).write_text("mine")
    before = (bare / "report.md").read_text()
    assert main(["report", str(bare)]) == 1
    assert f"{name}: was not written by rcnn-odom report" in capsys.readouterr().err
    assert (bare / name).read_text() == "mine"
    assert (bare / "report.md").read_text() == before


def test_no_finished_run_is_told(tmp_path, capsys):
    begin_run(tmp_path / "a", ["seed=0"])
    (tmp_path / "a" / "error.txt").write_text("the disk is full")
    assert main(["report", str(tmp_path)]) == 1
    assert "none of its 1 runs is finished; a: the disk is full" in capsys.readouterr().err


def test_other_versions_are_told(tmp_path):
    finish_run(tmp_path / "a", ["seed=0"], {"05": 0.1, "07": 0.1})
    finish_run(tmp_path / "b", ["seed=1"], {"05": 0.1, "07": 0.1}, versions={"torch": "2.14"})
    make_report(tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "> **Warning: the runs were made with different versions of torch.**" in text
    assert "torch 2.13.0 and 2.14" in text
    commands = "    rcnn-odom train seed=0\n    rcnn-odom train seed=1\n"
    assert f"Commands of the single runs:\n\n{commands}" in text


def test_curves_are_means_over_the_segments_of_all_sequences(tmp_path):
    test = method({"05": 0.1, "07": 0.4})
    few = {"segments": 2, "t_err": 0.1, "r_err_deg_per_m": 0.02}
    test["sequences"]["05"]["drift"]["per_length"] = {"50": few | {"segments": 30}, "100": few}
    more = {"segments": 10, "t_err": 0.4, "r_err_deg_per_m": 0.06}
    test["sequences"]["07"]["drift"]["per_length"] = {"50": more}
    finish_run(tmp_path / "a", ["seed=0"], {"05": 0.1, "07": 0.4}, test=test)
    curve = length_curve(read_run(tmp_path / "a", "a"))
    # Of 100 m there are two segments, which make no point; of 150 m none.
    np.testing.assert_allclose(curve, [[50, (30 * 10 + 10 * 40) / 40, (30 * 0.02 + 10 * 0.06) / 40]])


def test_the_run_that_is_shown_has_the_median_validation_drift(bare):
    runs = [read_run(bare / f"kernel_size=3,seed={seed}", str(seed)) for seed in (2, 0, 1)]
    assert median_run(runs).name == "1"
    assert median_run(runs[:2]).name == "0"
    make_report(bare)
    text = section((bare / "report.md").read_text(), "Trajectories")
    assert "The trajectories of `kernel_size=3,seed=1` are missing: " in text


def test_trajectories_start_ahead(finished):
    truth, estimate = trajectory(read_run(finished / "kernel_size=3,seed=0", "x"), "05")
    assert truth.shape == estimate.shape == (401, 2)
    # 0.9 m and more ahead in the first step, a tenth more in the estimate, and nearly straight.
    np.testing.assert_allclose(truth[1], [0.0, 0.9125], atol=0.01)
    np.testing.assert_allclose(estimate[1], [0.0, 1.1 * 0.9125], atol=0.01)


def test_text_of_others_stays_text():
    from markdown import markdown

    nasty = "a|b\n<i>c</i> & **d** `e` [f](http://g) ~h~ \\i _j_ $k$ snake_case a__b __l__"
    table = markdown(markdown_table(["x", "y"], [[nasty, "1"]]), extensions=["tables"])
    shown = re.search(r"<td>(.*?)</td>", table)[1]
    assert not re.search(r"<[a-z]", shown)
    decoded = re.sub(r"&#(\d+);", lambda found: chr(int(found[1])), shown)
    assert decoded == " ".join(nasty.split())
    names = markdown_table(["run", "x"], [["a__b", "a__b"], ["-", "-"]], names=["run"])
    assert names.splitlines()[2:] == ["| `a__b` | a&#95;&#95;b |", "| - | - |"]
    assert code("model.kernel_size=3") == "`model.kernel_size=3`"
    assert code("a`b") == escape("a`b") == "a&#96;b"


def test_names_of_sequences_are_those_of_the_files():
    assert file_name("c[0.5:]") == "c_0.5-"
    assert file_name("05") == "05"


def test_times_are_for_people():
    assert [duration(s) for s in (5.4, 90, 3725, None)] == ["5 s", "1 min 30 s", "1 h 02 min", "-"]
