"""Scores of drives by hand."""

import json
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_report import Estimates, report_icp, report_test
from rcnn_odom.evaluation.scores import (
    camera_trajectory,
    frame_errors,
    frame_table,
    percent,
    planar_drift,
    score,
    score_all,
    smooth,
    stretch_errors,
    table,
)
from rcnn_odom.geometry import FORWARD_CAMERA, compose, planar_to_poses
from rcnn_odom.models.constant import ConstantMotion, held_motion, mean_motion
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.icp import PointToLineICP, Steps
from rcnn_odom.recordings.cache import EncodedSequence
from rcnn_odom.recordings.trajectory import read_kitti, read_motions, write_motions


def drive(planar, name="drive", camera_from_laser=FORWARD_CAMERA):
    planar = np.asarray(planar, dtype=np.float64)
    scans, stamps = np.zeros((len(planar), 3), np.float32), np.arange(len(planar), dtype=np.float64)
    return EncodedSequence(name, "key", scans, planar_to_poses(planar), stamps, camera_from_laser)


def straight(frames=31, name="straight"):
    return drive([(frame, 0, 0) for frame in range(frames)], name)


def ahead(frames, distance):
    return np.tile([distance, 0.0], (frames - 1, 1))


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
    off = 2 * np.abs(1j - np.exp(1j * sides * np.pi / 2))
    report = score(sequence, sequence.motions, [3.0], apply)
    assert report["drift"]["t_err"] == report["floor"]["t_err"] == pytest.approx(off / 3, abs=1e-12)


def test_trajectory_is_in_the_frame_of_the_camera():
    poses = camera_trajectory(straight(3), np.array([[2.0, np.pi / 2], [1.0, 0.0]]), "start")
    # Ahead is z; left is -x.
    np.testing.assert_allclose(poses[:, :3, 3], [(0, 0, 0), (0, 0, 2), (-1, 0, 2)], atol=1e-12)


def test_camera_beside_the_laser_does_not_change_exact_motion():
    shifted = FORWARD_CAMERA.copy()
    shifted[:3, 3] = 0.3, -0.1, 0.5
    angles = np.linspace(0, 3, 61)
    planar = np.stack([10 * np.cos(angles), 10 * np.sin(angles), angles + np.pi / 2], axis=1)
    sequence = drive(planar, camera_from_laser=shifted)
    exact = planar_drift(sequence, compose(sequence.motions, "middle"), [5.0, 10.0])
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


def test_baselines_repeat_one_motion():
    scans = np.zeros((4, 3))
    mean = ConstantMotion(np.array([1.5, -0.1])).estimate(scans)
    np.testing.assert_allclose(mean, [[1.5, -0.1]] * 3)
    np.testing.assert_array_equal(held_motion().estimate(scans), np.zeros((3, 2)))


def test_odometry_that_never_moves_drifts_by_everything():
    report = score(straight(), held_motion().estimate(np.zeros((31, 3))), [10.0])
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


class StubModule(torch.nn.Linear):
    """Looks like a trained network to whoever reports on it."""

    variant = "cnn_reg"

    def __init__(self):
        super().__init__(1, 1)

    def network(self, pairs, state):
        return SimpleNamespace(motion=pairs[..., 0, :2]), state

    network.head = SimpleNamespace(mean=torch.tensor([0.75, 0.5]))


def test_a_report_leaves_the_motions_of_all_methods(tmp_path):
    sequence = drive([(0, 0, 0), (1, 0, 0), (1, 1.5, 0.25)], "05")
    module = StubModule()
    data = {"name": "kitti", "lengths": [1.0], "apply": "end"}
    report_test(module, Estimates({"05": np.array([[0.875, 0.0], [1.25, -0.5]])}), [sequence], data, tmp_path)
    header, first, second = (tmp_path / "trajectories" / "05_motions.csv").read_text().splitlines()
    assert header == (
        "frame,distance_m,heading_rad,true_distance_m,true_heading_rad,"
        "mean_motion_distance_m,mean_motion_heading_rad,held_motion_distance_m,held_motion_heading_rad"
    )
    assert first == "1,0.875,0,1,0,0.75,0.5,0,0"
    assert second == "2,1.25,-0.5,1.5,0.25,0.75,0.5,0,0"


SIDEWAYS = [(frame, 0.5 * frame, 0.1 * (frame % 2)) for frame in range(31)]
"""Half as far to the left as ahead, which a turn by half a degree cannot say."""


def test_poses_are_scored_with_their_sideways_part():
    sequence = drive(SIDEWAYS)
    cut_to_two = score(sequence, sequence.motions, [10.0])
    whole = score(sequence, sequence.motions, [10.0], poses=sequence.poses)
    assert whole["drift"]["t_err"] == pytest.approx(0, abs=1e-12)
    assert whole["drift"]["segments"] == cut_to_two["drift"]["segments"] > 0
    assert cut_to_two["drift"]["t_err"] > 0.1
    assert whole["floor"] == cut_to_two["floor"] == cut_to_two["drift"]
    assert whole["distance_mae_m"] == 0


def test_poses_by_name_stand_for_one_sequence_alone():
    sequences = [drive(SIDEWAYS, "a"), drive(SIDEWAYS, "b")]
    motions = {sequence.name: sequence.motions for sequence in sequences}
    report = score_all(sequences, motions, [10.0], poses={"a": sequences[0].poses})
    assert report["sequences"]["a"]["drift"]["t_err"] == pytest.approx(0, abs=1e-12)
    assert report["sequences"]["b"]["drift"]["t_err"] == report["sequences"]["b"]["floor"]["t_err"]


def test_the_report_of_scan_matching_has_whole_poses_failures_and_no_mean_motion(tmp_path, caplog):
    caplog.set_level("INFO")
    sequence = drive(SIDEWAYS, "05")
    # Steps of the truth, by hand: the frame before is turned by 0.1 in every second one.
    steps = []
    for (x0, y0, heading0), (x1, y1, heading1) in pairwise(SIDEWAYS):
        place = complex(x1 - x0, y1 - y0) * np.exp(-1j * heading0)
        steps.append((place.real, place.imag, heading1 - heading0))
    estimated = {"05": Steps(np.array(steps), np.arange(30) < 4)}
    data = {"name": "kitti", "lengths": [10.0], "apply": "end"}
    icp = PointToLineICP(Sensor(90.0, 180.0))
    report = report_icp(icp, estimated, None, [sequence], data, tmp_path)
    assert report["failures"] == {"05": 4}
    assert "4 of 30 on 05" in caplog.text
    assert report["test"]["drift"] == pytest.approx(0, abs=1e-9)
    assert list(report["baselines"]) == ["held_motion", "icp_two_numbers"]
    assert report["latency"]["frames"] == 30
    assert {"numpy", "scipy", "numba"} <= set(report["versions"])
    camera = read_kitti(tmp_path / "trajectories" / "05.txt")
    np.testing.assert_allclose(camera[:, [2, 0], 3] * [1, -1], np.array(SIDEWAYS)[:, :2], atol=1e-9)
    truth, methods = read_motions(tmp_path / "trajectories" / "05_motions.csv")
    np.testing.assert_allclose(methods["estimate"], truth, atol=1e-12)
    assert (tmp_path / "figures" / "05_trajectory.png").exists()


def test_wheel_odometry_is_not_cut_to_two_numbers_either(tmp_path):
    sequence = drive(SIDEWAYS, "05")
    moved = planar_to_poses([(7, 8, 1.0)]) @ sequence.poses
    sequence = replace(sequence, wheel_odometry=moved)
    steps = {"05": Steps(np.zeros((30, 3)), np.ones(30, dtype=bool))}
    data = {"name": "carmen", "lengths": [10.0], "apply": "end"}
    report = report_icp(PointToLineICP(Sensor(90.0, 180.0)), steps, None, [sequence], data, tmp_path)
    assert report["baselines"]["wheel_odometry"]["drift"] == pytest.approx(0, abs=1e-9)


def test_mean_motion_is_that_of_all_training_drives(caplog):
    drives = {"a": straight(3, "a"), "b": drive([(0, 0, 0), (4, 0, 0.3)], "b")}

    def read(name):
        if name not in drives:
            raise InputError(f"{name}: no such folder")
        return drives[name]

    found = mean_motion(read, ["a", "b"])
    np.testing.assert_allclose(found.motion, [(1 + 1 + 4) / 3, 0.1])
    caplog.set_level("INFO")
    assert mean_motion(read, ["a", "c"]) is None
    assert "mean_motion is left out" in caplog.text
    assert "c: no such folder" in caplog.text
