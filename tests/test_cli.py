"""The command line, in this process and in one of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rcnn_odom
from rcnn_odom.cli import main
from rcnn_odom.metrics.drift import drift
from rcnn_odom.trajectory import read_kitti, write_kitti

SOURCE = Path(rcnn_odom.__file__).parents[1]


def run(*arguments, **options):
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    command = [sys.executable, "-m", "rcnn_odom.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False, **options)


def straight(frames, step=1.0):
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = step * np.arange(frames)
    return poses


@pytest.fixture
def drive(tmp_path):
    """Paths of a truth of 299 m and an estimate 2 % too long."""
    paths = tmp_path / "truth.txt", tmp_path / "estimate.txt"
    write_kitti(paths[0], straight(300))
    write_kitti(paths[1], straight(300, 1.02))
    return [str(path) for path in paths]


@pytest.fixture
def short(tmp_path):
    path = tmp_path / "short.txt"
    write_kitti(path, straight(36))
    return str(path)


def test_drift_as_text(drive, capsys):
    assert main(["drift", *drive]) == 0
    output = capsys.readouterr()
    # 101 m are the first more than 100 m, 201 m the first more than 200 m.
    expected = (20 * 0.0202 + 10 * 0.0201) / 30
    assert f"{100 * expected:.4f} %" in output.out
    assert f"(ratio {expected:.6f})" in output.out
    assert "30        (a start every 10 frames, full 3D)" in output.out
    rows = [line.split() for line in output.out.splitlines()]
    assert ["100", "20", "2.0200", "0.000000"] in rows
    assert ["200", "10", "2.0100", "0.000000"] in rows
    assert "no segment of 300, 400, 500, 600, 700, 800 m in a path of 299 m" in output.out
    assert output.err == ""


@pytest.mark.parametrize("planar", [False, True])
def test_drift_as_json(drive, capsys, planar):
    options = ["--planar"] if planar else []
    assert main(["drift", *drive, "--json", "--lengths", "50,20", "--step", "5", *options]) == 0
    result = json.loads(capsys.readouterr().out)
    poses = [read_kitti(path) for path in drive]
    expected = drift(*poses, planar=planar, lengths=(20, 50), step=5)
    assert result == {**expected.to_dict(), "planar": planar, "lengths": [20, 50]}
    assert result["segments"] == len(range(0, 300 - 21, 5)) + len(range(0, 300 - 51, 5))


def test_planar_ignores_height(tmp_path, drive, capsys):
    poses = straight(300)
    poses[:, 1, 3] = 0.5 * np.arange(300)
    write_kitti(tmp_path / "climbing.txt", poses)
    assert main(["drift", drive[0], str(tmp_path / "climbing.txt"), "--planar"]) == 0
    assert "0.0000 %" in capsys.readouterr().out


def test_too_short_says_what_to_try(short, capsys):
    assert main(["drift", short, short]) == 1
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err == (
        "rcnn-odom: error: no segment of 100, 200, 300, 400, 500, 600, 700, 800 m in a path of 35 m: "
        "try --lengths 5,10,20\n"
    )
    assert main(["drift", short, short, "--lengths", "5,10,20"]) == 0


def test_too_short_as_json_is_null(short, capsys):
    assert main(["drift", short, short, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["t_err"], result["r_err_deg_per_m"], result["segments"]) == (None, None, 0)
    assert result["per_length"] == {}


def test_a_path_that_stands_still(tmp_path, capsys):
    path = str(tmp_path / "still.txt")
    write_kitti(path, straight(50, 0.0))
    assert main(["drift", path, path]) == 1
    assert "give recordings that move" in capsys.readouterr().err


def one_line_error(capsys):
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("rcnn-odom: error: ")
    assert output.err.count("\n") == 1
    return output.err


def test_bad_files_give_one_line(tmp_path, drive, short, capsys):
    assert main(["drift", drive[0], str(tmp_path / "none.txt")]) == 1
    assert "none.txt: cannot be read: No such file" in one_line_error(capsys)
    assert main(["drift", str(tmp_path), drive[1]]) == 1
    assert "Is a directory" in one_line_error(capsys)
    (tmp_path / "bad.txt").write_text("1 2 3\n")
    assert main(["drift", drive[0], str(tmp_path / "bad.txt")]) == 1
    assert "bad.txt:1: found 3 fields" in one_line_error(capsys)
    assert main(["drift", drive[0], short]) == 1
    assert "300 poses but the estimate 36" in one_line_error(capsys)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read every file")
def test_a_file_that_may_not_be_read(drive, capsys):
    os.chmod(drive[1], 0)
    assert main(["drift", *drive]) == 1
    assert "Permission denied" in one_line_error(capsys)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--lengths", "ten"], "is not a list of numbers"),
        (["--lengths", ""], "is not a list of numbers"),
        (["--lengths", "10,,20"], "is not a list of numbers"),
        (["--lengths", "10,0"], "must be positive"),
        (["--lengths=-5"], "must be positive"),
        (["--lengths", "nan"], "must be positive"),
        (["--step", "0"], "1 or more"),
        (["--step", "2.5"], "1 or more"),
        (["--nonsense"], "unrecognized arguments"),
    ],
)
def test_wrong_usage(drive, capsys, options, message):
    with pytest.raises(SystemExit) as exit_status:
        main(["drift", *drive, *options])
    assert exit_status.value.code == 2
    assert message in capsys.readouterr().err


def test_a_command_is_needed(capsys):
    with pytest.raises(SystemExit) as exit_status:
        main([])
    assert exit_status.value.code == 2
    assert "COMMAND" in capsys.readouterr().err


def test_as_a_process(drive):
    version = run("--version")
    assert (version.returncode, version.stdout) == (0, f"rcnn-odom {rcnn_odom.__version__}\n")
    result = run("drift", *drive, "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["segments"] == 30
    result = run("drift", drive[0], "none.txt")
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr.startswith("rcnn-odom: error: none.txt: ")


def test_a_reader_that_leaves_gets_no_traceback(drive):
    reading, writing = os.pipe()
    os.close(reading)
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    command = [sys.executable, "-m", "rcnn_odom.cli", "drift", *drive]
    result = subprocess.run(
        command, stdout=writing, stderr=subprocess.PIPE, text=True, env=environment, check=False
    )
    os.close(writing)
    assert (result.returncode, result.stderr) == (1, "")


def test_drift_does_not_wait_for_torch(drive):
    code = f"""
import sys
from rcnn_odom.cli import main
main({["drift", *drive]!r})
print("torch" in sys.modules)
"""
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True
    )
    assert result.stdout.splitlines()[-1] == "False"
