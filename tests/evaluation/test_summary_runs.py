"""The table of a sweep's runs: what is read, what is refused, what counts."""

import json

import numpy as np
import pytest
import yaml

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.sweep_report import load_runs
from rcnn_odom.evaluation.sweep_report.runs_table import read_sweep
from summary_runs import begin_run, finish_run, method, metrics_of, older, settings_of

DRIFTS = {"05": 0.2, "07": 0.1}


def finish_sweep(folder, kernels=(3, 5), seeds=(0, 1), **options):
    for kernel in kernels:
        for seed in seeds:
            overrides = [
                "model=cnn_cls",
                f"model.kernel_size={kernel}",
                f"seed={seed}",
                "+sweeps=kernel_size",
            ]
            drifts = {"05": 0.01 * kernel + 0.001 * seed, "07": 0.02 * kernel}
            finish_run(folder / f"kernel_size={kernel},seed={seed}", overrides, drifts, **options)


def test_one_row_a_run_with_its_scores(tmp_path):
    finish_sweep(tmp_path)
    table = load_runs(tmp_path)
    assert table.attrs["options"] == ["model.kernel_size"]
    assert list(table["run"]) == [f"kernel_size={k},seed={s}" for k in (3, 5) for s in (0, 1)]
    assert list(table["model.kernel_size"]) == [3, 3, 5, 5]
    assert list(table["seed"]) == [0, 1, 0, 1]
    assert set(table["status"]) == {"finished"}
    assert set(table["variant"]) == {"cnn_cls"}
    assert set(table["data"]) == {"simulated"}
    np.testing.assert_allclose(table["drift_05"], [0.03, 0.031, 0.05, 0.051])
    np.testing.assert_allclose(table["drift_07"], [0.06, 0.06, 0.10, 0.10])
    np.testing.assert_allclose(table["drift"], [0.045, 0.0455, 0.075, 0.0755])
    np.testing.assert_allclose(table["floor"], 0.004)
    np.testing.assert_allclose(table["val_drift"], 0.2)
    np.testing.assert_allclose(table["rotation_deg_per_m"], table["drift"] / 10)
    assert set(table["latency_ms"]) == {4.0}
    assert set(table["seconds"]) == {90.0}
    assert table["same_as"].isna().all()
    assert table["repeats"].isna().all()


@pytest.mark.parametrize("version", [dict, older])
def test_frame_errors_are_means_over_motions_and_the_largest(tmp_path, version):
    finish_run(tmp_path / "a", ["seed=0"], DRIFTS, test=version(method(DRIFTS)))
    row = load_runs(tmp_path).iloc[0]
    # 400 motions of 05 with 0.25 m, 300 of 07 with 0.35 m.
    mean = (400 * 0.25 + 300 * 0.35) / 700
    assert row["distance_mae_m"] == pytest.approx(mean)
    assert row["distance_bias_m"] == pytest.approx(-mean / 2)
    assert row["heading_mae_deg"] == pytest.approx(2 * mean)
    assert row["heading_bias_deg"] == pytest.approx(mean)
    assert row["distance_max_m"] == pytest.approx(3 * 0.35)
    assert row["heading_max_deg"] == pytest.approx(6 * 0.35)


def test_older_runs_tell_less(tmp_path):
    finish_run(tmp_path / "a", ["seed=0"], DRIFTS, latency=None, training=None, versions=None)
    row = load_runs(tmp_path).iloc[0]
    assert row["drift"] == pytest.approx(0.15)
    assert np.isnan(row["latency_ms"])
    assert np.isnan(row["seconds"])


def test_a_drive_too_short_for_a_drift_has_none(tmp_path):
    test = older(method(DRIFTS))
    nothing = {"t_err": None, "r_err_deg_per_m": None, "t_rmse": None, "segments": 0}
    test["sequences"]["07"]["drift"] = nothing
    finish_run(tmp_path / "a", ["seed=0"], DRIFTS, test=test | {"drift": 0.2})
    row = load_runs(tmp_path).iloc[0]
    assert row["status"] == "finished"
    assert np.isnan(row["drift_07"])
    assert row["rotation_deg_per_m"] == pytest.approx(0.02)


def test_runs_that_are_not_finished_have_a_row_with_the_reason(tmp_path):
    finish_sweep(tmp_path, seeds=(0,))
    for name, seed in (("kernel_size=3,seed=1", 1), ("kernel_size=3,seed=2", 2), ("kernel_size=3,seed=3", 3)):
        begin_run(tmp_path / name, ["model=cnn_cls", "model.kernel_size=3", f"seed={seed}"])
    (tmp_path / "kernel_size=3,seed=1" / "error.txt").write_text("no such\nfolder\n")
    (tmp_path / "kernel_size=3,seed=3" / "metrics.json").write_text('{"seed": 3, "test": {"dri')
    (tmp_path / "kernel_size=3,seed=4" / ".hydra").mkdir(parents=True)
    (tmp_path / "kernel_size=3,seed=4" / ".hydra" / "overrides.yaml").write_text("[seed=4]")
    begin_run(tmp_path / "kernel_size=3,seed=5", ["seed=5"])
    (tmp_path / "kernel_size=3,seed=5" / "config.yaml").write_text("data: {")
    asked = [f"kernel_size=3,seed={seed}" for seed in (5, 6, 7)]
    table = load_runs(tmp_path, expected=asked).set_index("run")
    assert table.loc["kernel_size=3,seed=0", "status"] == "finished"
    assert table.loc["kernel_size=3,seed=1", "status"] == "failed"
    assert table.loc["kernel_size=3,seed=1", "problem"] == "no such folder"
    assert table.loc["kernel_size=3,seed=1", "model.kernel_size"] == 3
    assert table.loc["kernel_size=3,seed=2", "status"] == "unfinished"
    assert table.loc["kernel_size=3,seed=3", "status"] == "damaged"
    assert "metrics.json cannot be read" in table.loc["kernel_size=3,seed=3", "problem"]
    assert "config.yaml" in table.loc["kernel_size=3,seed=4", "problem"]
    assert table.loc["kernel_size=3,seed=5", "problem"] == "config.yaml cannot be read"
    missing = table[table["status"] == "missing"]
    assert list(missing.index) == ["kernel_size=3,seed=6", "kernel_size=3,seed=7"]
    assert set(missing["problem"]) == {
        "the last command of the sweep should have made this folder, but it does not exist"
    }
    assert table.loc[table["status"] != "finished", "drift"].isna().all()


@pytest.mark.parametrize("content", ["[]", "{}", '{"test": {"sequences": {}}}', '{"test": NaN}', "3"])
def test_a_metrics_file_of_another_form_is_damaged(tmp_path, content):
    finish_sweep(tmp_path, seeds=(0,))
    begin_run(tmp_path / "z", ["model.kernel_size=3", "seed=1"])
    (tmp_path / "z" / "metrics.json").write_text(content)
    assert load_runs(tmp_path).set_index("run").loc["z", "status"] == "damaged"


@pytest.mark.parametrize(
    "key", ["variant", "data", "test", "baselines", "val", "versions", "latency", "training"]
)
def test_a_spoiled_part_of_a_metrics_file_is_damage(tmp_path, key):
    spoiled = None if key in ("variant", "data", "test") else ["x"]
    assert _status_with(tmp_path, {key: spoiled}) == "damaged"


@pytest.mark.parametrize("metrics", [["x"], {"drift": "low"}, None])
def test_metrics_of_another_form_are_damage(tmp_path, metrics):
    assert _status_with(tmp_path, {"test": method(DRIFTS) | {"metrics": metrics}}) == "damaged"


@pytest.mark.parametrize("key", ["drift", "floor", "lengths", "sequences"])
def test_a_part_that_a_score_lacks_is_damage(tmp_path, key):
    test = method(DRIFTS)
    del test[key]
    assert _status_with(tmp_path, {"test": test}) == "damaged"


@pytest.mark.parametrize("key", sorted(method(DRIFTS)["sequences"]["07"]))
def test_a_part_that_a_sequence_lacks_is_damage(tmp_path, key):
    test = older(method(DRIFTS))
    del test["sequences"]["07"][key]
    assert _status_with(tmp_path, {"test": test}) == "damaged"
    assert _status_with(tmp_path, {"baselines": {"held_motion": test}}) == "damaged"


def _status_with(folder, changes):
    """Of a run whose metrics file has these values instead; those with None it lacks."""
    if not (folder / "a").exists():
        begin_run(folder / "a", ["seed=0"])
    (folder / "a" / "metrics.json").write_text(json.dumps(metrics_of(settings_of({}), DRIFTS, **changes)))
    return load_runs(folder)["status"].item()


def test_a_first_stage_belongs_to_its_run(tmp_path):
    finish_run(tmp_path / "a", ["seed=0"], DRIFTS)
    finish_run(tmp_path / "a" / "first_stage", ["seed=0"], DRIFTS, training={"seconds": 33.0, "epochs": 1})
    (tmp_path / "latest").symlink_to("a")
    table = load_runs(tmp_path)
    assert list(table["run"]) == ["a"]
    assert list(table["first_stage_seconds"]) == [33.0]


def forget_seed(run):
    settings = yaml.safe_load((run / "config.yaml").read_text())
    settings.pop("seed")
    (run / "config.yaml").write_text(yaml.safe_dump(settings))


def test_a_training_without_a_seed_is_damaged(tmp_path):
    finish_run(tmp_path / "a", ["seed=0"], DRIFTS, seed=0)
    finish_run(tmp_path / "b", ["seed=1"], DRIFTS, seed=1)
    forget_seed(tmp_path / "b")
    table = load_runs(tmp_path)
    assert table["status"].tolist() == ["finished", "damaged"]
    assert table["problem"][1] == "config.yaml has no seed"


def test_evaluations_are_no_runs(tmp_path):
    finish_run(tmp_path / "a", ["seed=0"], DRIFTS)
    finish_run(tmp_path / "b" / "matcher", ["run=a"], DRIFTS, seed=None, variant="matcher")
    forget_seed(tmp_path / "b" / "matcher")  # scan matching has none
    other = {"data.test": ["00"]}
    finish_run(tmp_path / "b" / "other", ["run=a"], {"05": 0.1}, other, seed=None, variant="matcher")
    begin_run(tmp_path / "b" / "stopped", ["run=a"])
    (tmp_path / "b" / "stopped" / ".hydra" / "hydra.yaml").write_text("hydra: {job: {name: evaluate}}")
    sweep = read_sweep(tmp_path)
    assert [run.name for run in sweep.runs] == ["a"]
    assert [run.name for run in sweep.evaluations] == ["b/matcher"]
    assert sweep.left_out == ["b/other"]
    assert list(load_runs(tmp_path)["run"]) == ["a"]


def test_a_repeated_training_counts_once(tmp_path):
    for name, same in (("a", "outputs/c"), ("b", None), ("c", None)):
        finish_run(tmp_path / name, ["seed=7"], DRIFTS, same_as=same)
    table = load_runs(tmp_path).set_index("run")
    assert table["repeats"].dropna().to_dict() == {"a": "b", "c": "b"}
    ((seeds,),) = [[seeds] for seeds in read_sweep(tmp_path).by_setting.values()]
    assert {seed: run.name for seed, run in seeds.items()} == {7: "b"}


def test_settings_are_in_the_order_of_their_numbers(tmp_path):
    for beta in (10.0, 0.5, 2.0):
        for variant in ("rcnn_reg", "cnn_reg"):
            finish_run(tmp_path / f"{variant}-{beta}", [f"model={variant}", f"model.beta={beta}"], DRIFTS)
    sweep = read_sweep(tmp_path)
    assert sweep.options == ["model.variant", "model.beta"]
    labels = [sweep.label(setting) for setting in sweep.by_setting]
    assert labels == [f"{v}, beta={b}" for v in ("cnn_reg", "rcnn_reg") for b in (0.5, 2.0, 10.0)]


def test_unnamed_differences_are_settings_of_their_own(tmp_path):
    """A default that changed between two runs must not be averaged over."""
    finish_run(tmp_path / "a", ["seed=0"], DRIFTS, {"model.epochs": 10, "outputs": "x"})
    finish_run(tmp_path / "b", ["seed=1"], DRIFTS, {"model.epochs": 20, "data.workers": 3})
    assert load_runs(tmp_path).attrs["options"] == ["model.epochs"]


def test_lists_are_options_too(tmp_path):
    finish_run(tmp_path / "a", ["data.train=[a,b]"], DRIFTS)
    finish_run(tmp_path / "b", ["data.train=[a]"], DRIFTS)
    assert list(load_runs(tmp_path)["data.train"]) == [("a", "b"), ("a",)]


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("data.name", "kitti", "simulated and kitti"),
        ("data.test", ["05"], r"\[05,07\] and \[05\]"),
        ("data.lengths", [1.0], r"\[50.0,100.0,150.0\] and \[1.0\]"),
        ("data.sensor.max_range", 40.0, "80.0 and 40.0"),
        ("data.scale", "full", "small and full"),
        ("data.realism.tilt", False, "true and false"),
    ],
)
def test_mixed_data_are_refused(tmp_path, option, value, said):
    finish_run(tmp_path / "a", ["seed=0"], DRIFTS)
    finish_run(tmp_path / "b", ["seed=1"], DRIFTS, {option: value})
    with pytest.raises(InputError, match=rf"^a and b differ in {option}, {said}: .*--only {option}="):
        load_runs(tmp_path)


def test_mixed_data_are_told_apart_by_only(tmp_path):
    finish_run(tmp_path / "a", ["data.scale=small"], DRIFTS)
    finish_run(tmp_path / "b", ["data.scale=full"], DRIFTS)
    finish_run(tmp_path / "c", ["seed=1"], DRIFTS)
    with pytest.raises(InputError, match=r"a and b differ in data\.scale"):
        load_runs(tmp_path)
    assert list(load_runs(tmp_path, ["data.scale=small"])["run"]) == ["a", "c"]
    assert list(load_runs(tmp_path, ["data.scale=full"])["run"]) == ["b"]
    assert list(load_runs(tmp_path, ["data.test=[05,07]", "data.scale=full", "data=simulated"])["run"]) == [
        "b"
    ]
    with pytest.raises(
        InputError, match=r"^--only data\.scale=big: no run has this value; they have full, small$"
    ):
        load_runs(tmp_path, ["data.scale=big"])
    with pytest.raises(
        InputError, match=r"^--only scale=full: no run has this value; give an option's full name"
    ):
        load_runs(tmp_path, ["scale=full"])
    with pytest.raises(InputError, match="write KEY=VALUE"):
        load_runs(tmp_path, ["full"])


def test_a_swept_part_of_the_simulation_may_differ(tmp_path):
    finish_run(tmp_path / "a", ["data.realism.tilt=true"], DRIFTS)
    finish_run(tmp_path / "b", ["data.realism.tilt=false"], DRIFTS)
    assert load_runs(tmp_path).attrs["options"] == ["data.realism.tilt"]


def test_other_sequences_in_the_scores_are_refused(tmp_path):
    finish_run(tmp_path / "a", ["seed=0"], DRIFTS)
    finish_run(tmp_path / "b", ["seed=1"], {"05": 0.1})
    with pytest.raises(InputError, match="a was tested on 05, 07, b on 05: "):
        load_runs(tmp_path)


def test_no_runs_are_told(tmp_path):
    with pytest.raises(InputError, match="nowhere: no such folder; name the folder of a sweep"):
        load_runs(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no run in it; train some"):
        load_runs(tmp_path)
    finish_run(tmp_path / "a", ["run=x"], DRIFTS, seed=None)
    with pytest.raises(InputError, match="no run in it, only evaluations"):
        load_runs(tmp_path)
    with pytest.raises(InputError, match="this is the folder of one run"):
        load_runs(tmp_path / "a")


def test_the_fake_runs_are_like_real_ones():
    """The errors of a frame that the table takes are those that a scoring writes."""
    from rcnn_odom.evaluation.metrics import all_metrics, frame_errors

    real = frame_errors(np.ones((3, 2)), np.zeros((3, 2)))
    assert method(DRIFTS)["metrics"].keys() == all_metrics().keys()
    assert real.keys() - method(DRIFTS)["sequences"]["05"].keys() == {"moving", "standing"}
