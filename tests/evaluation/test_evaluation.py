"""Scores of drives by hand."""

import json
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from rcnn_odom import registry
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.latency import measure
from rcnn_odom.evaluation.metrics import Metric, all_metrics, frame_errors, planar_drift, score_metrics
from rcnn_odom.evaluation.run_report import report_drives
from rcnn_odom.evaluation.scores import (
    coverage,
    coverage_table,
    frame_table,
    metrics_table,
    percent,
    score,
    score_all,
    smooth,
    stretch_errors,
    table,
)
from rcnn_odom.evaluation.sweep_report import load_runs
from rcnn_odom.evaluation.sweep_report.build import make_report
from rcnn_odom.geometry import FORWARD_CAMERA, Step, Steps, change_frame, planar_to_poses
from rcnn_odom.models.constant import held_motion
from rcnn_odom.models.contract import Description
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.two_numbers import steps_of
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.trajectory import read_kitti, read_motions, write_motions
from summary_runs import finish_run


def drive(planar, name="drive", camera_from_laser=FORWARD_CAMERA):
    planar = np.asarray(planar, dtype=np.float64)
    scans, stamps = np.zeros((len(planar), 3), np.float32), np.arange(len(planar), dtype=np.float64)
    return Drive(name, "key", scans, planar_to_poses(planar), stamps, camera_from_laser)


def straight(frames=31, name="straight"):
    return drive([(frame, 0, 0) for frame in range(frames)], name)


def ahead(frames, distance):
    return Steps.with_unknown_covariance(np.tile([distance, 0.0, 0.0], (frames - 1, 1)))


def in_two_numbers(sequence, apply="end"):
    return Steps.with_unknown_covariance(steps_of(sequence.motions, apply))


def test_errors_are_signed_where_they_say_so():
    truth = np.array([[1.0, 0.1], [1.0, 0.0], [2.0, -0.1], [2.0, 0.0]])
    error = np.array([[0.1, 0.02], [-0.3, 0.0], [0.0, -0.05], [0.0, 0.0]])
    errors = frame_errors(truth + error, truth)
    assert errors["distance_mae_m"] == pytest.approx(0.1)
    assert errors["distance_bias_m"] == pytest.approx(-0.05)
    assert errors["distance_max_m"] == pytest.approx(0.3)
    assert errors["heading_mae_deg"] == pytest.approx(np.degrees(0.0175))
    assert errors["heading_bias_deg"] == pytest.approx(np.degrees(-0.0075))
    assert errors["heading_max_deg"] == pytest.approx(np.degrees(0.05))


def test_too_short_an_estimate_has_a_negative_bias():
    errors = frame_errors(np.array([[0.9, 0.0]]), np.array([[1.0, 0.0]]))
    assert errors["distance_bias_m"] == pytest.approx(-0.1)


def test_heading_error_goes_the_short_way_round():
    errors = frame_errors(np.array([[0.0, np.pi - 0.01]]), np.array([[0.0, -np.pi + 0.01]]))
    assert errors["heading_bias_deg"] == pytest.approx(-np.degrees(0.02))
    assert errors["heading_max_deg"] == pytest.approx(np.degrees(0.02))


def test_moving_and_standing_are_told_apart_by_the_truth():
    truth = np.array([[0.0, 0.0], [0.005, -0.003], [0.02, 0.0], [-0.02, 0.0], [0.0, 0.01], [1.0, 0.2]])
    error = np.array([[0.2, 0.0], [0.4, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.8, 0.0]])
    errors = frame_errors(truth + error, truth)
    assert errors["standing"]["frames"] == 2
    assert errors["moving"]["frames"] == 4
    assert errors["standing"]["distance_mae_m"] == pytest.approx(0.3)
    assert errors["moving"]["distance_mae_m"] == pytest.approx(0.2)


def test_no_frame_has_no_error():
    errors = frame_errors(np.array([[1.1, 0.0]]), np.array([[1.0, 0.0]]))
    assert errors["standing"] == {"frames": 0}


def test_arguments_are_left_alone():
    motions, truth = np.array([[1.1, 3.0]]), np.array([[1.0, -3.0]])
    frame_errors(motions, truth)
    assert motions.tolist() == [[1.1, 3.0]]
    assert truth.tolist() == [[1.0, -3.0]]


def test_drift_of_a_straight_drive_by_hand():
    # Segments end at the first frame beyond their length: 0-11, 10-21 and 0-21, a tenth of it too far.
    report = score(straight(), ahead(31, 1.1), [10.0, 20.0])
    assert report["frames"] == 31
    assert report["drift"]["segments"] == 3
    assert report["drift"]["t_err"] == pytest.approx((0.11 + 0.11 + 0.105) / 3)
    assert report["drift"]["t_rmse"] == pytest.approx(np.sqrt((2 * 0.11**2 + 0.105**2) / 3))
    assert report["drift"]["per_length"]["20"]["t_err"] == pytest.approx(0.105)
    assert report["floor"]["t_err"] == pytest.approx(0, abs=1e-12)
    assert report["distance_bias_m"] == pytest.approx(0.1)


@pytest.mark.parametrize(("apply", "sides"), [("start", 0.0), ("middle", 0.5), ("end", 1.0)])
def test_step_is_taken_where_asked_for(apply, sides):
    # Two steps with a right angle at the first frame: the truth goes left at once (turned at the start).
    sequence = drive([(0, 0, 0), (0, 2, np.pi / 2), (0, 4, np.pi / 2)])
    # Of the two metres to the left, two numbers keep what is along the heading in mid-turn, 45 degrees.
    off = np.abs(2j - np.sqrt(2) * np.exp(1j * sides * np.pi / 2))
    report = score(sequence, in_two_numbers(sequence, apply), [3.0], apply)
    assert report["drift"]["t_err"] == report["floor"]["t_err"] == pytest.approx(off / 3, abs=1e-12)


def test_trajectory_is_in_the_frame_of_the_camera():
    steps = Steps.with_unknown_covariance(steps_of([[2.0, np.pi / 2], [1.0, 0.0]], "start"))
    poses = change_frame(steps.poses(), FORWARD_CAMERA)
    # Ahead is z; left is -x.
    np.testing.assert_allclose(poses[:, :3, 3], [(0, 0, 0), (0, 0, 2), (-1, 0, 2)], atol=1e-12)


def test_camera_beside_the_laser_does_not_change_exact_motion():
    shifted = FORWARD_CAMERA.copy()
    shifted[:3, 3] = 0.3, -0.1, 0.5
    angles = np.linspace(0, 3, 61)
    planar = np.stack([10 * np.cos(angles), 10 * np.sin(angles), angles + np.pi / 2], axis=1)
    sequence = drive(planar, camera_from_laser=shifted)
    exact = planar_drift(sequence, in_two_numbers(sequence, "middle"), [5.0, 10.0])
    assert exact.segments > 5
    assert exact.t_err == pytest.approx(0, abs=1e-9)


def test_no_segment_is_no_score_and_a_dash():
    sequences = [straight(name="long"), straight(6, name="short")]
    motions = {"long": ahead(31, 1.1), "short": ahead(6, 1.1)}
    report = score_all(sequences, motions, [20.0])
    assert report["sequences"]["short"]["drift"]["t_err"] is None
    assert report["sequences"]["short"]["drift"]["segments"] == 0
    assert report["drift"] == pytest.approx(0.105)
    assert report["lengths"] == [20.0]
    lines = [line.split() for line in table({"cnn_reg": report, "held_motion": report}).splitlines()]
    assert lines == [
        ["drift", "in", "%", "long", "short", "mean"],
        ["floor", "of", "two-number", "motion", "0.00", "-", "0.00"],
        ["cnn_reg", "10.50", "-", "10.50"],
        ["held_motion", "10.50", "-", "10.50"],
        ["segments", "1", "0"],
    ]
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_nothing_to_score_is_none():
    report = score_all([straight(6)], {"straight": ahead(6, 1.0)}, [100.0])
    assert report["drift"] is None
    assert report["floor"] is None
    assert "nan" not in table({"method": report})


def test_mean_is_over_sequences():
    sequences = [straight(31, "a"), straight(101, "b")]
    motions = {"a": ahead(31, 1.1), "b": ahead(101, 1.2)}
    report = score_all(sequences, motions, [10.0])
    assert report["drift"] == pytest.approx((0.11 + 0.22) / 2)


@pytest.mark.parametrize(("ratio", "text"), [(None, "-"), (0.0, "0.00"), (0.0255, "2.55"), (1.0, "100.00")])
def test_percent(ratio, text):
    assert percent(ratio) == text


def test_odometry_that_never_moves_drifts_by_everything():
    report = score(straight(), held_motion().estimate(straight()), [10.0])
    assert report["drift"]["t_err"] == pytest.approx(1.1)


# Weights that Savitzky and Golay printed for parabolas over 5 and over 11 points.
PRINTED = {5: np.array([-3, 12, 17, 12, -3]) / 35}
PRINTED[11] = np.array([-36, 9, 44, 69, 84, 89, 84, 69, 44, 9, -36]) / 429


@pytest.mark.parametrize(("frames", "window"), [(5, 5), (6, 5), (11, 11), (12, 11), (40, 11)])
def test_smoothing_has_the_printed_weights(frames, window):
    distances = np.random.default_rng(3).normal(1, 0.05, frames)
    middle = window // 2
    assert smooth(distances)[middle] == pytest.approx(PRINTED[window] @ distances[:window])


@pytest.mark.parametrize("frames", [1, 2, 3, 4])
def test_too_few_frames_are_not_smoothed(frames):
    distances = np.array([1.0, 4.0, -2.0, 0.5])[:frames]
    np.testing.assert_allclose(smooth(distances), distances, atol=1e-12)


def test_a_stretch_is_scored_against_the_truth_smoothed_over_the_whole_drive():
    # The truth jumps by 1 m at one frame, of which the filter leaves 89/429 there and 84/429 beside it.
    truth = np.tile([1.0, 0.0], (11, 1))
    truth[5, 0] = 2.0
    report = stretch_errors(np.tile([1.0, 0.01], (11, 1)), truth, slice(5, 7))
    assert report["distance_mae_m"] == pytest.approx(0.5)
    assert report["distance_bias_m"] == pytest.approx(-0.5)
    assert report["distance_max_m"] == pytest.approx(1.0)
    assert report["smoothed_distance_mae_m"] == pytest.approx((89 + 84) / 429 / 2)
    assert report["smoothed_distance_bias_m"] == pytest.approx(-(89 + 84) / 429 / 2)
    assert report["smoothed_distance_max_m"] == pytest.approx(89 / 429)
    assert report["heading_bias_deg"] == pytest.approx(np.degrees(0.01))
    assert report["moving"]["frames"] == 2
    assert report["path_m"] == pytest.approx(3.0)


@pytest.mark.parametrize(("apply", "end"), [("end", 7 * np.sqrt(2)), ("start", 4 * np.sqrt(2))])
def test_the_end_point_of_a_stretch_by_hand(apply, end):
    # From the second frame on: the truth turns left, to (0, 7) or (3, 4), the estimate goes to (7, 0).
    truth = np.array([[5.0, 0.3], [3.0, np.pi / 2], [4.0, 0.0]])
    motions = np.array([[9.0, -0.2], [3.0, 0.0], [4.0, 0.0]])
    report = stretch_errors(motions, truth, slice(1, 3), apply)
    assert report["path_m"] == pytest.approx(7)
    assert report["end_m"] == pytest.approx(end)
    assert report["end_ratio"] == pytest.approx(end / 7)


def test_the_path_goes_on_in_reverse_and_a_standing_one_has_no_ratio():
    truth = np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    motions = truth + np.array([0.1, 0.0])
    assert stretch_errors(motions, truth, slice(0, 2))["end_ratio"] == pytest.approx(0.2 / 4)
    standing = stretch_errors(motions, truth, slice(2, 4))
    assert (standing["path_m"], standing["end_ratio"]) == (0.0, None)
    assert standing["end_m"] == pytest.approx(0.2)
    assert frame_table({"estimate": standing}).split()[-2:] == ["0.200", "-"]


def test_motions_are_read_as_they_were_written(tmp_path):
    motions, truth, held = np.random.default_rng(0).normal(size=(3, 4, 2)) / 3
    write_motions(tmp_path / "motions.csv", motions, truth, {"held_motion": held})
    read_truth, methods = read_motions(tmp_path / "motions.csv")
    np.testing.assert_array_equal(read_truth, truth)
    assert list(methods) == ["estimate", "held_motion"]
    np.testing.assert_array_equal(methods["estimate"], motions)
    np.testing.assert_array_equal(methods["held_motion"], held)


LATENCY = {"median_ms": 1.0, "p99_ms": 2.0, "frames": 100, "threads": 1}


class Standing:
    """A stepper that sees no motion, and counts."""

    description = Description(Sensor(90.0, 180.0))

    def __init__(self):
        self.pairs = []

    def __call__(self, pair):
        self.pairs.append(pair)
        return Step(0.0, 0.0, 0.0)

    def reset(self):
        self.pairs.append(None)


def test_a_report_leaves_the_motions_of_all_methods(tmp_path):
    sequence = drive([(0, 0, 0), (1, 0, 0), (1, 1.5, 0.25)], "05")
    data = {"name": "kitti", "lengths": [1.0], "apply": "end"}
    steps = Steps.with_unknown_covariance(steps_of([[0.875, 0.0], [1.25, -0.5]], "end"))
    mean = np.array([0.75, 0.0, 0.0])
    report = report_drives("cnn_reg", {"05": steps}, mean, LATENCY, [sequence], data, tmp_path)
    header, first, second = (tmp_path / "trajectories" / "05_motions.csv").read_text().splitlines()
    assert header == (
        "frame,distance_m,heading_rad,true_distance_m,true_heading_rad,"
        "mean_motion_distance_m,mean_motion_heading_rad,held_motion_distance_m,held_motion_heading_rad"
    )
    assert first == "1,0.875,0,1,0,0.75,0,0,0"
    values = [float(cell) for cell in second.split(",")]
    # Driven at the end of the turn: projected on the heading in mid-turn, a quarter of a radian before.
    truth = 1.5 * np.cos(np.pi / 2 - 0.125)
    np.testing.assert_allclose(values, [2, 1.25 * np.cos(0.25), -0.5, truth, 0.25, 0.75, 0, 0, 0])
    assert list(report) == ["test", "baselines", "latency", "path_ratio", "versions"]


SIDEWAYS = [(frame, 0.5 * frame, 0.1 * (frame % 2)) for frame in range(31)]
"""Half as far to the left as ahead, which a turn by half a degree cannot say."""


def test_steps_are_scored_with_their_sideways_part():
    sequence = drive(SIDEWAYS)
    cut_to_two = score(sequence, in_two_numbers(sequence), [10.0])
    whole = score(sequence, Steps.with_unknown_covariance(sequence.steps), [10.0])
    assert whole["drift"]["t_err"] == pytest.approx(0, abs=1e-12)
    assert whole["drift"]["segments"] == cut_to_two["drift"]["segments"] > 0
    assert cut_to_two["drift"]["t_err"] > 0.1
    assert whole["floor"] == cut_to_two["floor"] == cut_to_two["drift"]
    assert whole["distance_mae_m"] == 0


def test_the_report_of_whole_steps_has_a_row_of_two_numbers_and_no_mean_motion(tmp_path, caplog):
    caplog.set_level("INFO")
    sequence = drive(SIDEWAYS, "05")
    # Steps of the truth, by hand: the frame before is turned by 0.1 in every second one.
    steps = []
    for (x0, y0, heading0), (x1, y1, heading1) in pairwise(SIDEWAYS):
        place = complex(x1 - x0, y1 - y0) * np.exp(-1j * heading0)
        steps.append((place.real, place.imag, heading1 - heading0))
    estimated = {"05": Steps.with_unknown_covariance(steps)}
    data = {"name": "kitti", "lengths": [10.0], "apply": "end"}
    figures = {}
    report = report_drives(
        "matcher", estimated, None, LATENCY, [sequence], data, tmp_path, figures.__setitem__
    )
    assert report["test"]["drift"] == pytest.approx(0, abs=1e-9)
    assert list(report["baselines"]) == ["held_motion", "matcher_two_numbers"]
    assert {"numpy", "scipy", "numba"} <= set(report["versions"])
    assert "coverage" not in report
    assert table({"matcher": report["test"], **report["baselines"]}) in caplog.text
    assert metrics_table({"matcher": report["test"], **report["baselines"]}) in caplog.text
    camera = read_kitti(tmp_path / "trajectories" / "05.txt")
    np.testing.assert_allclose(camera[:, [2, 0], 3] * [1, -1], np.array(SIDEWAYS)[:, :2], atol=1e-9)
    truth, methods = read_motions(tmp_path / "trajectories" / "05_motions.csv")
    np.testing.assert_allclose(methods["estimate"], truth, atol=1e-12)
    assert (tmp_path / "figures" / "05_trajectory.png").exists()
    assert list(figures) == ["test/05_trajectory", "test/05_motion"]


@pytest.mark.parametrize("apply", ["start", "middle", "end"])
def test_rounding_to_single_precision_makes_no_row_of_two_numbers(tmp_path, apply):
    sequence = drive(SIDEWAYS, "05")
    rounded = in_two_numbers(sequence, apply).values.astype(np.float32)
    data = {"name": "kitti", "lengths": [10.0], "apply": apply}
    steps = {"05": Steps.with_unknown_covariance(rounded)}
    report = report_drives("rcnn_reg", steps, None, LATENCY, [sequence], data, tmp_path)
    assert list(report["baselines"]) == ["held_motion"]


def test_wheel_odometry_is_not_cut_to_two_numbers_either(tmp_path):
    sequence = drive(SIDEWAYS, "05")
    moved = planar_to_poses([(7, 8, 1.0)]) @ sequence.poses
    sequence = replace(sequence, wheel_odometry=moved)
    data = {"name": "carmen", "lengths": [10.0], "apply": "end"}
    steps = {"05": held_motion().estimate(sequence)}
    report = report_drives("matcher", steps, None, LATENCY, [sequence], data, tmp_path)
    assert report["baselines"]["wheel_odometry"]["drift"] == pytest.approx(0, abs=1e-9)


def test_the_time_of_a_frame_is_that_of_a_stream(tmp_path):
    sequence = drive([(frame, 0, 0) for frame in range(130)], "05")
    sequence = replace(sequence, scans=np.arange(390, dtype=np.float32).reshape(130, 3))
    data = {"name": "kitti", "lengths": [10.0], "apply": "end"}
    stepper = Standing()
    latency = measure(stepper, sequence.scans)
    report = report_drives("x", {"05": ahead(130, 1.0)}, None, latency, [sequence], data, tmp_path)
    assert report["latency"] == latency
    assert set(latency) == {"median_ms", "p99_ms", "frames", "threads"}
    assert (latency["frames"], latency["threads"]) == (100, 1)
    resets = [place for place, pair in enumerate(stepper.pairs) if pair is None]
    begin = resets[1] + 1  # after the frames that warm up
    measured = stepper.pairs[begin : begin + 100]
    np.testing.assert_array_equal(measured, [sequence.scans[frame : frame + 2] for frame in range(100)])
    assert stepper.pairs[begin + 100 :] == [None]


def test_coverage_by_hand(tmp_path):
    # The estimate turns by 60 degrees, so its distance goes along 30 degrees; the errors there are 0.3 and
    # 0.1 m, and of the heading 0.02 and 0.05 radians.
    turn, along = np.pi / 3, np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    values = np.array([[*(1.0 * along), turn]] * 3)
    truth_motions = np.array([[0.7, turn - 0.02], [0.9, turn + 0.05], [9.0, 0.0]])
    truth = steps_of(truth_motions, "middle")
    across = np.array([-along[1], along[0]])
    covariances = np.full((3, 3, 3), np.nan)
    covariances[:2] = 0.0
    covariances[:2, :2, :2] = 0.2**2 * np.outer(along, along) + 7.0**2 * np.outer(across, across)
    covariances[:2, 2, 2] = 0.03**2
    steps = Steps(values, covariances)
    report = coverage(steps, truth)
    # Error over deviation: 1.5 and 0.5 of the distance, 0.67 and 1.67 of the heading; the last is unknown.
    assert report["distance"] == {"1": 0.5, "2": 1.0}
    assert report["heading"] == {"1": 0.5, "2": 1.0}
    assert report["distance_m"] == pytest.approx(0.2)
    assert report["heading_deg"] == pytest.approx(np.degrees(0.03))
    assert coverage_table({"05": report}).splitlines()[-1].split() == [
        *["05", "50.0", "100.0", "50.0", "100.0", "0.200", "1.719"]
    ]
    assert coverage(Steps.with_unknown_covariance(values), truth) is None
    # Checkpoints of version 0.1 do not know how far a step goes to the side, but how well they know the turn.
    covariances = covariances.copy()
    covariances[:, :2] = covariances[:, :, :2] = np.nan
    heading = coverage(Steps(values, covariances), truth)
    assert heading == {name: report[name] for name in ("heading", "heading_deg")}
    assert coverage_table({"05": heading}).splitlines()[-1].split() == [
        "05",
        "-",
        "-",
        *["50.0", "100.0", "-", "1.719"],
    ]
    sequence = drive([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)], "05")
    data = {"name": "kitti", "lengths": [1.0], "apply": "middle"}
    written = report_drives("net", {"05": steps}, None, LATENCY, [sequence], data, tmp_path)
    assert written["coverage"].keys() == {"05"}
    assert (tmp_path / "figures" / "coverage.png").exists()


def most_ahead(drive, steps, lengths):
    """The farthest place of an estimate, in metres; none of a drive named short."""
    return None if drive.name == "short" else float(steps.poses()[:, 0, 3].max())


FARTHEST = Metric("farthest_m", "farthest", "km", "higher", most_ahead, "max", 1e-3, 3)


def add_metrics(monkeypatch, **added):
    """Metrics as other packages add them."""
    entries = [
        SimpleNamespace(name=name, value="package:metric", load=lambda metric=metric: metric)
        for name, metric in added.items()
    ]
    find = {"rcnn_odom.metrics": entries}.__getitem__
    monkeypatch.setattr(registry, "entries_of", find)


def test_a_metric_of_another_package_is_everywhere(monkeypatch, tmp_path):
    add_metrics(monkeypatch, farthest_m=FARTHEST)
    drives = [straight(31, "05"), straight(21, "07"), straight(11, "short")]
    steps = {one.name: ahead(len(one), 1.1) for one in drives}
    report = score_all(drives, steps, [10.0])
    assert report["sequences"]["05"]["farthest_m"] == pytest.approx(33)
    assert report["sequences"]["short"]["farthest_m"] is None
    assert report["metrics"]["farthest_m"] == pytest.approx(33)
    assert list(report["metrics"]) == list(all_metrics())
    lines = metrics_table({"cnn_reg": report}).splitlines()
    assert lines[0].endswith("farthest (km)")
    assert lines[1].endswith(" 0.033")
    report["metrics"]["farthest_m"] = 1234.0
    finish_run(tmp_path / "a", ["seed=0"], {"05": 0.1, "07": 0.1}, test=report)
    finish_run(tmp_path / "b", ["seed=1"], {"05": 0.1, "07": 0.1}, {"data.test": ["05", "07"]})
    (tmp_path / "b" / "metrics.json").unlink()
    assert load_runs(tmp_path)["farthest_m"][0] == 1234.0
    text = make_report(tmp_path).markdown.read_text()
    assert "| farthest (km) |" in text
    assert "| 1.234 |" in text
    # A run from before the metric was added has none.
    del report["metrics"]["farthest_m"]
    finish_run(tmp_path / "c", ["seed=2"], {"05": 0.1, "07": 0.1}, test=report)
    assert load_runs(tmp_path)["farthest_m"].isna().tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("name", "metric", "said"),
    [
        ("best", most_ahead, "is not a Metric of"),
        ("best", FARTHEST, "is named farthest_m"),
        ("floor", replace(FARTHEST, name="floor"), "is named floor"),
        ("best", replace(FARTHEST, name="best", combine="median"), "set combine to mean, frames or max"),
        ("best", replace(FARTHEST, name="best", compute=3), "give it a function compute"),
        ("drift", replace(FARTHEST, name="drift"), "two metrics are called drift"),
    ],
)
def test_what_is_no_metric_is_refused_in_a_line(monkeypatch, name, metric, said):
    add_metrics(monkeypatch, **{name: metric})
    with pytest.raises(InputError, match=said) as refused:
        all_metrics()
    assert "\n" not in str(refused.value)


def test_a_metric_may_give_a_number_of_numpys(monkeypatch):
    add_metrics(monkeypatch, ones=replace(FARTHEST, name="ones", compute=lambda *_: np.float32(1)))
    report = score_all([straight(31, "a")], {"a": ahead(31, 1.1)}, [5.0])
    assert json.loads(json.dumps(report))["metrics"]["ones"] == 1.0


def test_metrics_are_combined_as_they_say():
    drives = [straight(31, "a"), straight(11, "b")]
    steps = {"a": ahead(31, 1.1), "b": ahead(11, 0.8)}
    metrics = score_all(drives, steps, [5.0])["metrics"]
    assert metrics["distance_mae_m"] == pytest.approx((30 * 0.1 + 10 * 0.2) / 40)
    assert metrics["distance_bias_m"] == pytest.approx((30 * 0.1 - 10 * 0.2) / 40)
    assert metrics["distance_max_m"] == pytest.approx(0.2)
    # Segments of 5 m end at the sixth frame, 0.1 or 0.2 m a frame off.
    assert metrics["drift"] == pytest.approx((0.6 / 5 + 1.2 / 5) / 2)
    assert [name for name, metric in all_metrics().items() if metric.in_training] == [
        *["drift", "distance_mae_m", "heading_mae_deg"]
    ]


def test_a_metric_that_is_no_number_is_none(monkeypatch):
    add_metrics(monkeypatch, farthest_m=replace(FARTHEST, compute=lambda *_: np.nan))
    assert score_metrics(straight(), ahead(31, 1.0), [5.0])["farthest_m"] is None
