"""Trajectories against relations between scans, by hand and on real logs."""

import json

import numpy as np
import pytest

from conftest import ROOT
from data.make_carmen import make_carmen
from rcnn_odom.cli import main
from rcnn_odom.cli import relations as cli_relations
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import travelled
from rcnn_odom.evaluation.relations import (
    LOOP_PATH,
    Relations,
    find_scans,
    read_relations,
    relation_errors,
    score_relations,
    stamp_keys,
    summarise,
)
from rcnn_odom.geometry import FORWARD_CAMERA, change_frame, planar_to_poses
from rcnn_odom.recordings import carmen
from rcnn_odom.recordings.trajectory import read_tum, write_kitti, write_tum

REAL = ROOT.parent / "shared" / "data" / "carmen"
FRAMES = 60


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A log, its true poses (x, y, heading) and stamps, and exact relations: 12 short, two long."""
    folder = tmp_path_factory.mktemp("log")
    planar = make_carmen(folder, "robot", frames=FRAMES)
    stamps = 1000 + 0.2 * np.arange(FRAMES)
    pairs = [(first, first + 4) for first in range(0, 48, 4)] + [(0, 50), (5, 59)]
    lines = []
    for first, second in pairs:
        x, y, heading = planar[second] - planar[first]
        place = complex(x, y) * np.exp(-1j * planar[first, 2])
        times = f"{stamps[first]:.6f} {stamps[second]:.6f}"
        lines.append(f"{times} {place.real:.9f} {place.imag:.9f} 0 0 0 {heading:.9f}")
    (folder / "robot.relations").write_text("\n".join(lines) + "\n")
    return folder, planar, stamps


def camera(planar):
    return change_frame(planar_to_poses(planar), FORWARD_CAMERA)


def score(capsys, folder, estimate, *options, log="robot.log", relations="robot.relations"):
    status = main(
        ["relations", str(folder / log), str(estimate), str(folder / relations), "--json", *options]
    )
    output = capsys.readouterr()
    assert status == 0, output.err
    return json.loads(output.out)


def refuse(capsys, folder, estimate, relations="robot.relations"):
    assert main(["relations", str(folder / "robot.log"), str(estimate), str(folder / relations)]) == 1
    output = capsys.readouterr()
    assert output.err.startswith("rcnn-odom: error: ")
    assert output.err.count("\n") == 1
    return output.err


def test_errors_by_hand():
    # From the origin the estimate goes 3 m ahead and turns left; the truth goes 3 m left and turns around.
    poses = planar_to_poses([(0, 0, 0), (3, 0, np.pi / 2)])
    errors = relation_errors(poses, np.array([[0, 1]]), np.array([[0.0, 3.0, np.pi]]))
    np.testing.assert_allclose(errors, [[3 * np.sqrt(2), np.pi / 2]])


def test_an_error_does_not_ask_where_the_trajectory_begins():
    poses = planar_to_poses([(1, 2, 0.5), (1.5, 2.5, 0.9)])
    moved = planar_to_poses([(7, -3, 2.0)]) @ poses
    steps = np.array([[0.6, 0.1, 0.3]])
    pair = np.array([[0, 1]])
    np.testing.assert_allclose(relation_errors(moved, pair, steps), relation_errors(poses, pair, steps))


def test_headings_go_the_short_way_round():
    poses = planar_to_poses([(0, 0, 0), (0, 0, np.pi - 0.01)])
    errors = relation_errors(poses, np.array([[0, 1]]), np.array([[0, 0, -np.pi + 0.01]]))
    assert errors[0, 1] == pytest.approx(0.02)


def test_mean_median_and_nothing():
    report = summarise(np.array([[0.0, 0.1], [0.3, 0.2], [0.9, 0.6]]))
    assert report["count"] == 3
    assert report["translation_mean_m"] == pytest.approx(0.4)
    assert report["translation_median_m"] == pytest.approx(0.3)
    assert report["rotation_mean_deg"] == pytest.approx(np.degrees(0.3))
    assert report["rotation_median_deg"] == pytest.approx(np.degrees(0.2))
    assert summarise(np.empty((0, 2))) == {"count": 0}


def test_scans_are_found_by_stamps_out_of_order():
    stamps = stamp_keys([5.0, 3.0, 976052905.167303, 4.0])
    times = stamp_keys([[3.0, 4.0], [976052905.167303, 5.0], [3.1, 5.0]]).reshape(3, 2)
    assert find_scans(Relations(times, np.zeros((3, 3))), stamps).tolist() == [[1, 3], [2, 0], [-1, 0]]


def test_equal_stamps_are_refused_where_they_matter():
    relations = Relations(stamp_keys([[1.0, 2.0]]), np.zeros((1, 3)))
    with pytest.raises(InputError, match=r"2\.000000 s is the stamp of several scans"):
        find_scans(relations, stamp_keys([1.0, 2.0, 2.0]))
    assert find_scans(relations, stamp_keys([1.0, 2.0, 3.0, 3.0])).tolist() == [[0, 1]]


def test_loops_are_told_by_the_way_between_and_everything_left_out_is_counted():
    stamps, driven = stamp_keys(np.arange(5.0)), np.array([0.0, 1.0, 2.0, 30.0, 31.0])
    poses = planar_to_poses([(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 0, 0), (3, 0, 0)])
    poses[4] = np.nan
    times = stamp_keys([[0, 1], [2, 0], [0, 3], [3, 4], [0, 9]])
    steps = np.array([[1.0, 0, 0], [-2, 0.5, 0], [2, 0, 0.1], [1, 0, 0], [1, 0, 0]])
    report = score_relations(Relations(times, steps), stamps, driven, poses)
    assert report["sequential"]["count"] == 2
    assert report["sequential"]["translation_mean_m"] == pytest.approx(0.25)
    assert report["loop"]["count"] == 1
    assert report["loop"]["rotation_mean_deg"] == pytest.approx(np.degrees(0.1))
    assert report["all"]["count"] == 3
    assert (report["not_in_log"], report["not_in_estimate"]) == (1, 1)
    assert score_relations(Relations(times, steps), stamps, driven, poses, 50.0)["loop"] == {"count": 0}


def test_a_perfect_trajectory_in_every_format(recording, tmp_path, capsys):
    folder, planar, stamps = recording
    write_kitti(tmp_path / "est.txt", camera(planar))
    write_tum(tmp_path / "est.tum", stamps, camera(planar))
    write_tum(tmp_path / "laser.tum", stamps, planar_to_poses(planar))
    for name, *options in (("est.txt",), ("est.tum",), ("laser.tum", "--frame", "laser")):
        report = score(capsys, folder, tmp_path / name, *options)
        assert [report[group]["count"] for group in ("sequential", "loop", "all")] == [12, 2, 14]
        assert report["all"]["translation_mean_m"] == pytest.approx(0, abs=1e-6)
        assert report["all"]["rotation_mean_deg"] == pytest.approx(0, abs=1e-5)
        assert (report["not_in_log"], report["not_in_estimate"]) == (0, 0)


def test_a_trajectory_that_is_a_tenth_too_long(recording, tmp_path, capsys):
    folder, planar, _ = recording
    write_kitti(tmp_path / "long.txt", camera(planar * [1.1, 1.1, 1]))
    report = score(capsys, folder, tmp_path / "long.txt")
    lengths = [np.hypot(*(planar[first + 4] - planar[first])[:2]) for first in range(0, 48, 4)]
    assert report["sequential"]["translation_mean_m"] == pytest.approx(0.1 * np.mean(lengths), rel=1e-5)
    assert report["sequential"]["translation_median_m"] == pytest.approx(0.1 * np.median(lengths), rel=1e-5)
    assert report["all"]["rotation_mean_deg"] == pytest.approx(0, abs=1e-5)


def test_a_part_of_a_log_is_found_by_its_stamps(recording, tmp_path, capsys):
    folder, planar, stamps = recording
    write_tum(tmp_path / "part.tum", stamps[10:30], camera(planar[10:30]))
    report = score(capsys, folder, tmp_path / "part.tum")
    # Scans 12 to 16, 16 to 20, 20 to 24 and 24 to 28.
    assert report["all"]["count"] == 4
    assert report["not_in_estimate"] == 10
    assert report["all"]["translation_mean_m"] == pytest.approx(0, abs=1e-6)


def test_the_table_says_what_was_left_out_and_where_loops_begin(recording, tmp_path, capsys):
    folder, planar, stamps = recording
    write_tum(tmp_path / "part.tum", stamps[:45], camera(planar[:45]))
    arguments = [str(folder / "robot.log"), str(tmp_path / "part.tum"), str(folder / "robot.relations")]
    assert main(["relations", *arguments]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].split() == ["sequential", "11", "0.0000", "0.0000", "0.0000", "0.0000"]
    assert lines[3].split() == ["loop", "0", "-", "-", "-", "-"]
    assert "loop: more than 5 m driven between its scans" in lines
    assert "left out: 3 relations whose times are not in the estimate" in lines


def test_bad_files_give_one_line(recording, tmp_path, capsys):
    folder, planar, stamps = recording
    good = tmp_path / "good.txt"
    write_kitti(good, camera(planar))
    write_kitti(tmp_path / "short.txt", camera(planar[:50]))
    message = refuse(capsys, folder, tmp_path / "short.txt")
    assert "50 poses, but" in message
    assert "has 60 scans" in message
    write_tum(tmp_path / "other.tum", stamps + 0.05, camera(planar))
    assert "other.tum:1: no scan of" in refuse(capsys, folder, tmp_path / "other.tum")
    assert "none.txt: cannot be read" in refuse(capsys, folder, tmp_path / "none.txt")
    lines = (folder / "robot.relations").read_text().splitlines()
    for text, message in (
        ("", "is empty"),
        ("\n".join([lines[0], "1 2 3"]), "bad.relations:2: found 3 fields, but a relation has 8 numbers"),
        ("\n".join([*lines[:2], lines[2].replace(" 0 0 0 ", " 0 nan 0 ")]), "bad.relations:3: found"),
        ("1 2 0 0 0 0 0 0", "the log has the scans of none of the 1 relations"),
    ):
        (folder / "bad.relations").write_text(text)
        assert message in refuse(capsys, folder, good, "bad.relations")


def test_tum_is_read_as_it_was_written(tmp_path):
    poses = camera(np.random.default_rng(0).normal(size=(5, 3)))
    stamps = 976052905.167303 + np.arange(5)
    write_tum(tmp_path / "a.tum", stamps, poses)
    read_stamps, read_poses = read_tum(tmp_path / "a.tum")
    np.testing.assert_allclose(read_stamps, stamps, atol=1e-6)
    np.testing.assert_allclose(read_poses, poses, atol=1e-8)
    (tmp_path / "b.tum").write_text("0 1 2 3 0 0 0 2\n")
    with pytest.raises(InputError, match=r"b\.tum: the pose of .* s has no unit quaternion"):
        read_tum(tmp_path / "b.tum")


@pytest.mark.skipif(not REAL.is_dir(), reason=f"no real logs in {REAL}")
def test_wheel_odometry_of_a_real_log():
    log = carmen.load("aces", root=REAL)
    relations = read_relations(REAL / "relations" / "aces.relations")
    driven = np.cumsum([0, *np.hypot(*np.diff(log.wheel_odometry[:, :2, 3], axis=0).T)])
    report = score_relations(relations, stamp_keys(log.stamps), driven, log.wheel_odometry)
    assert (report["not_in_log"], report["not_in_estimate"]) == (0, 0)
    assert report["all"]["count"] == 1279
    # Published for the sequential ones: 3.7 cm and 0.87 degrees.
    assert report["sequential"]["translation_mean_m"] == pytest.approx(0.037, abs=0.002)
    assert report["sequential"]["rotation_mean_deg"] == pytest.approx(0.87, abs=0.03)
    # No loop lies near the limit by which they are told apart.
    scans = find_scans(relations, stamp_keys(log.stamps))
    way = np.abs(np.diff(driven[scans], axis=1))
    assert not ((way > 1) & (way < 10)).any()


def test_comments_in_a_tum_file_are_skipped(tmp_path):
    (tmp_path / "a.tum").write_text("# stamp x y z qx qy qz qw\n1.5 1 2 3 0 0 0 1\n")
    stamps, poses = read_tum(tmp_path / "a.tum")
    assert stamps.tolist() == [1.5]
    assert poses[0, :3, 3].tolist() == [1, 2, 3]


def test_the_help_tells_the_default_of_the_metric():
    assert cli_relations.LOOP_PATH == LOOP_PATH


@pytest.mark.skipif(not REAL.is_dir(), reason=f"no real logs in {REAL}")
@pytest.mark.parametrize("log", ["aces", "intel"])
def test_loops_lie_far_from_sequential_relations_on_real_logs(log):
    relations = read_relations(REAL / "relations" / f"{log}.relations")
    drive = carmen.load(log, root=REAL)
    scans = find_scans(relations, stamp_keys(drive.stamps))
    first, second = travelled(drive.wheel_odometry)[scans[(scans >= 0).all(1)]].T
    way = np.abs(second - first)
    assert way[way < LOOP_PATH].max() < 0.6
    assert way[way > LOOP_PATH].min() > 10
