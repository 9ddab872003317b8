"""Names in TensorBoard and its text cards, read back from the event files."""

import re
import shlex

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from conftest import ROOT, configure_in
from rcnn_odom.evaluation.metrics import Metric
from rcnn_odom.evaluation.scores import percent
from rcnn_odom.training import run_card, tensorboard
from rcnn_odom.training.machine import resolve_precision
from train import train


@pytest.fixture(scope="module")
def trained(kitti, tmp_path_factory):
    """Folder and metrics of a finished run."""
    folder = tmp_path_factory.mktemp("cnn_cls")
    metrics = train(configure_in(folder)("model=cnn_cls", *kitti))
    return folder / "outputs" / "run", metrics


def test_names_in_tensorboard_are_words_with_units(trained):
    run, metrics = trained
    events = EventAccumulator(str(run / "tensorboard"), {"tensors": 0, "images": 0})
    events.Reload()
    tags = events.Tags()
    scores = (
        "mean absolute {} error",
        "mean signed {} error",
        "largest {} error",
    )
    errors = [
        f"{score.format(name)} in {unit}"
        for name, unit in (("distance", "m"), ("heading", "deg"))
        for score in scores
    ]
    losses = "loss", "loss, part distance", "loss, part rotation", "headings outside classes"
    assert set(tags["scalars"]) == {
        *(f"Training: mean of each epoch/{name}" for name in (*losses, "number of the epoch, from 0")),
        *(f"Training: every 10 steps/{name}" for name in (*losses, "learning rate")),
        *(
            f"Validation: after each epoch/{name}, {drive}"
            for name in ("drift in %", "rotational drift in deg/m")
            for drive in ("all drives", "drive 10")
        ),
        *(f"Validation: after each epoch/{name}" for name in errors if "mean absolute" in name),
        *(f"Best checkpoint: drift/test drift in %, {drive}" for drive in ("all drives", "drive 05")),
        "Best checkpoint: drift/validation drift in %, all drives",
        "Best checkpoint: other test scores/rotational drift in deg/m",
        *(f"Best checkpoint: other test scores/{name}" for name in errors),
    }
    # The tab Custom Scalars draws no line for a name with parentheses.
    assert not any(set("()") & set(tag) for tag in tags["scalars"])
    assert set(tags["images"]) == {
        "Test of the best checkpoint/drive 05: estimated and true path",
        "Test of the best checkpoint/drive 05: rotation and translation of each frame",
        "Test of the best checkpoint/all drives: test drift by length",
        "Test of the best checkpoint/all drives: errors within the estimated uncertainty",
    }
    steps = metrics["training"]["steps"]
    assert {event.step for tag in tags["images"] for event in events.Images(tag)} == {steps}
    validation = events.Scalars("Validation: after each epoch/drift in %, all drives")
    assert len(validation) == 2, "a point for each epoch: the HParams row must not purge them"
    assert min(event.value for event in validation) == pytest.approx(100 * metrics["val"]["drift"])
    (test,) = events.Scalars("Best checkpoint: drift/test drift in %, all drives")
    assert (test.step, test.value) == (steps, pytest.approx(100 * metrics["test"]["drift"], rel=1e-6))
    hparams = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    assert b"model.kernel_size" in hparams


def read_text(run, tag):
    events = EventAccumulator(str(run / "tensorboard"), {"tensors": 0})
    events.Reload()
    (event,) = events.Tensors(tag)
    return event.step, event.tensor_proto.string_val[0].decode()


def test_a_text_card_says_what_the_run_is(trained):
    run, metrics = trained
    step, text = read_text(run, "About this run")
    assert step == 0
    rows = dict(
        line[4:].split(":** ", 1) for line in text.splitlines() if line.startswith("- **") and ":** " in line
    )
    steps = metrics["training"]["steps"]
    precision = resolve_precision("auto", "cpu")
    expected = {
        "Model": r"`cnn_cls` with [\d,]+ weights",
        "Data": "`kitti`, read as `kitti`",
        "Training drives": r"`00` \(60 scans, \d+ m\)",
        "Validation drives": r"`10` \(60 scans, \d+ m\)",
        "Test drives": r"`05` \(60 scans, \d+ m\)",
        "Laser": "field of view 360°, 361 bins of 1°, ranges up to 80 m",
        "Seed": "0",
        "Length": f"{steps} steps in 2 epochs; a step is a batch of 8 pairs of consecutive scans",
        "Processor": r".+, \d+ threads?",
        "Precision": f"`{precision}` in training; scores are always computed in fp32",
        "Code": r"rcnn-odom \S+, (commit [0-9a-f]+(, with local changes)?|not from .*); PyTorch .*",
        "Results": f"in `{run}`: `metrics.json`, .*`train.log`",
    }
    assert rows.keys() == expected.keys()
    for name, pattern in expected.items():
        assert re.fullmatch(pattern, rows[name]), (name, rows[name])
    assert "started from Python, not by a command" in text


def test_a_text_card_has_the_test_drift_as_tables(trained):
    run, metrics = trained
    step, text = read_text(run, "Test results")
    assert step == metrics["training"]["steps"]
    tables = read_tables(text)
    test = metrics["test"]
    for name, report in {"cnn_cls": test, **metrics["baselines"]}.items():
        row = tables["Test drift in % by drive"][name]
        assert row == {
            "drive 05": percent(report["sequences"]["05"]["drift"]["t_err"]),
            "mean": percent(report["drift"]),
        }
    lengths = test["sequences"]["05"]["drift"]["per_length"]
    row = {f"{length} m": percent(part["t_err"]) for length, part in lengths.items()}
    assert tables["Test drift in % by length of the segments"] == {"drive 05": row}
    assert set(lengths) == {"10", "20"}
    other = tables["Other scores over all test drives"]["heading, mean abs (deg)"]
    assert float(other["cnn_cls"]) == pytest.approx(test["metrics"]["heading_mae_deg"], abs=1e-4)
    assert f"is **{percent(test['drift'])} %** on the test drives" in text


def read_tables(text):
    """Tables of a Markdown text: cells by the heading before the table, the row's and the column's name."""
    tables = {}
    for heading, block in re.findall(r"^#+ (.*)\n\n((?:\|.*\n)+)", text, re.MULTILINE):
        header, _, *rows = (
            [cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()
        )
        tables[heading] = {name: dict(zip(header[1:], cells, strict=True)) for name, *cells in rows}
    return tables


def test_a_stopped_training_is_called_unfinished(trained):
    _, metrics = trained
    stopped = metrics | {"training": metrics["training"] | {"stopped_by": "trainer.max_time", "epochs": 1}}
    text = run_card.describe_results({"model": {"epochs": 2}}, stopped)
    assert "not finished.** trainer.max_time stopped it after 1 of 2 epochs" in text
    assert "not finished" not in run_card.describe_results({"model": {"epochs": 2}}, metrics)


def test_drives_too_short_for_a_segment_have_a_card(trained):
    _, metrics = trained
    drift = {"t_err": None, "r_err_deg_per_m": None, "segments": 0, "per_length": {}}
    short = metrics["test"]["sequences"]["05"] | {"drift": drift, "floor": drift}
    test = metrics["test"] | {"drift": None, "floor": None, "sequences": {"05": short}}
    test["metrics"] = test["metrics"] | {"drift": None, "rotation_deg_per_m": None}
    text = run_card.describe_results({}, metrics | {"test": test, "baselines": {}})
    assert "is **- %** on the test drives" in text
    assert read_tables(text)["Test drift in % by drive"]["cnn_cls"] == {"drive 05": "-", "mean": "-"}
    assert tensorboard.TEST_DRIFT not in tensorboard.best_scalars(metrics | {"test": test})


def test_the_command_can_be_repeated(monkeypatch):
    options = ["model=cnn_cls", "data.train=['00','a b']", *(f"data.lengths=[{n}]" for n in range(1, 9))]
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("config", options, return_hydra_config=True)
    cfg.hydra.overrides.task = options
    monkeypatch.setattr(HydraConfig.instance(), "cfg", cfg)
    command = run_card.find_command()
    assert shlex.split(command.replace("\\\n", "")) == ["rcnn-odom", "train", *options]
    assert 1 < len(command.splitlines()) < len(options)
    assert max(map(len, command.splitlines())) <= run_card.COMMAND_WIDTH + 2


def test_scores_of_other_packages_have_names(monkeypatch):
    metric = Metric("jerk", "jerk (peak)", "m/s", "lower", lambda *_: 0.1, scale=10)
    monkeypatch.setattr(tensorboard, "all_metrics", lambda: {"jerk": metric})
    name = "Validation: after each epoch/jerk [peak] in m/s"
    assert tensorboard.validation_scalars({"val/jerk": 0.5, "loss": 1.0}) == {name: 5.0}
