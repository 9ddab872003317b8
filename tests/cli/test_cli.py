"""The command line, in this process and in one of its own."""

import json
import os
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

import rcnn_odom
from rcnn_odom.cli import main
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import drift
from rcnn_odom.geometry import relative_steps
from rcnn_odom.recordings import kitti, simulated
from rcnn_odom.recordings.trajectory import read_kitti, write_kitti

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
        (["--lengths", "ten"], "is not a number of metres above 0"),
        (["--lengths", ""], "is not a number of metres above 0"),
        (["--lengths", "10,,20"], "is not a number of metres above 0"),
        (["--lengths", "10,0"], "is not a number of metres above 0"),
        (["--lengths=-5"], "is not a number of metres above 0"),
        (["--lengths", "nan"], "is not a number of metres above 0"),
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
import runpy
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


HEADER = "frame,distance_m,heading_rad,true_distance_m,true_heading_rad"


@pytest.fixture
def motions(tmp_path):
    """Four frames, too few to be smoothed: straight ahead, and a baseline that never moves."""
    path = tmp_path / "05_motions.csv"
    path.write_text(
        f"{HEADER},held_motion_distance_m,held_motion_heading_rad\n"
        "1,1.5,0,1,0,0,0\n2,1.25,0,1,0,0,0\n3,1.75,0,2,0,0,0\n4,2,0.01,2,0,0,0\n"
    )
    return path


def test_frames_as_text(motions, capsys):
    assert main(["frames", str(motions)]) == 0
    title, _, groups, names, *rows = capsys.readouterr().out.splitlines()
    assert title == "frames 1 to 4 of 4, a path of 6.00 m"
    assert groups.split("-")[0].strip() == ""
    assert names.split()[:4] == ["mean", "abs", "signed", "largest"]
    # Errors of 0.5, 0.25, -0.25 and 0 m; the last turn comes before its step of 2 m, and 2 sin 0.01 = 0.02.
    distance, heading = ["0.2500", "+0.1250", "0.5000"], ["0.1432", "+0.1432", "0.5730"]
    assert rows[0].split() == ["estimate", *distance, *distance, *heading, "0.500", "8.34"]
    still = ["1.5000", "-1.5000", "2.0000"]
    right = ["0.0000", "+0.0000", "0.0000"]
    assert rows[1].split() == ["held_motion", *still, *still, *right, "6.000", "100.00"]
    assert len(rows) == 2
    assert len({len(line) for line in (groups, names, *rows)}) == 1


def test_frames_of_a_range_as_json(motions, capsys):
    assert main(["frames", str(motions), "--frames", "2:3", "--apply", "start", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["frames"], result["apply"]) == ([2, 3], "start")
    assert list(result["methods"]) == ["estimate", "held_motion"]
    estimate = result["methods"]["estimate"]
    assert estimate["distance_mae_m"] == pytest.approx(0.25)
    assert estimate["distance_bias_m"] == pytest.approx(0, abs=1e-12)
    assert (estimate["path_m"], estimate["end_m"], estimate["end_ratio"]) == (3, 0, 0)
    assert result["methods"]["held_motion"]["end_ratio"] == pytest.approx(1)


def test_frames_of_a_step_taken_before_its_turn(motions, capsys):
    assert main(["frames", str(motions), "--frames", "4:4", "--apply", "start", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["methods"]["estimate"]["end_m"] == 0
    assert main(["frames", str(motions), "--frames", "4:4", "--json"]) == 0
    end = json.loads(capsys.readouterr().out)["methods"]["estimate"]["end_m"]
    assert end == pytest.approx(4 * np.sin(0.005))  # a chord of 0.01 rad on a circle of 2 m


@pytest.mark.parametrize("frames", ["2:5", "0:2", "5:9"])
def test_frames_outside_of_the_drive(motions, capsys, frames):
    assert main(["frames", str(motions), "--frames", frames]) == 1
    message = f"05_motions.csv: --frames {frames} is outside of the drive, which has 4 frames: 1:4\n"
    assert one_line_error(capsys).endswith(message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ".csv: is empty; give a file of motions"),
        (
            "1 2 3\n",
            ".csv:1: the header must be frame,distance_m,heading_rad,true_distance_m,true_heading_rad",
        ),
        (f"{HEADER},slam_distance_m\n1,1,0,1,0,1\n", ".csv:1: the header must be"),
        (f"{HEADER},true_distance_m,true_heading_rad\n1,1,0,1,0,1,0\n", ".csv:1: the header must be"),
        (f"{HEADER}\n", ".csv: has no motion under its header"),
        (f"{HEADER}\n1,1,0,1,0\n2,1,x,1,0\n", ".csv:3: could not convert"),
        (f"{HEADER}\n1,1,0,1\n", ".csv:2: found 4 fields, but a line has 5"),
        (f"{HEADER}\n1,1,0,1,0\n\n2,1,0,1,0\n", ".csv:3: found 1 fields, but a line has 5"),
        (f"{HEADER}\n1,nan,0,1,0\n", ".csv:2: found nan or inf"),
        (f"{HEADER}\n1,1,0,1,0\n3,1,0,1,0\n", ".csv:3: frame 3 in place of 2"),
    ],
)
def test_bad_files_of_motions_give_one_line(tmp_path, capsys, text, message):
    (tmp_path / "bad.csv").write_text(text)
    assert main(["frames", str(tmp_path / "bad.csv")]) == 1
    assert message in one_line_error(capsys)


def test_no_file_of_motions(tmp_path, capsys):
    assert main(["frames", str(tmp_path / "none.csv")]) == 1
    assert "none.csv: cannot be read: No such file" in one_line_error(capsys)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frames", "39:20"], "'39:20' is empty"),
        (["--frames", "20"], "'20' is not a range of frames such as 20:39"),
        (["--frames", "a:b"], "is not a range of frames"),
        (["--frames=-3:4"], "is not a range of frames"),
        (["--apply", "never"], "invalid choice: 'never'"),
    ],
)
def test_wrong_usage_of_frames(motions, capsys, options, message):
    with pytest.raises(SystemExit) as exit_status:
        main(["frames", str(motions), *options])
    assert exit_status.value.code == 2
    assert message in capsys.readouterr().err


def test_simulate_writes_what_the_simulator_gives(tmp_path, capsys):
    options = ["--sequence", "00", "my drive", "--frames", "3", "--seed", "7", "--without", "movers"]
    assert main(["simulate", "--out", str(tmp_path / "out"), *options]) == 0
    assert capsys.readouterr().out == (
        f"wrote 00, my drive to {tmp_path}/out; score a trained network on them: "
        f'rcnn-odom evaluate data=kitti data.root={tmp_path}/out \'data.test=["00", "my drive"]\'\n'
    )
    for name in ("00", "my drive"):
        made = simulated.load(name, frames=3, seed=7, movers=False)
        read = kitti.load(name, root=tmp_path / "out")
        np.testing.assert_allclose(relative_steps(read.poses), relative_steps(made.poses), atol=1e-9)
        np.testing.assert_allclose(read.stamps, made.stamps, atol=1e-6)
        for frame in range(3):
            ours, theirs = made.read_scan(frame), read.read_scan(frame)
            np.testing.assert_array_equal(theirs.bearings, ours.bearings)
            np.testing.assert_array_equal(theirs.ranges, ours.ranges)


@pytest.fixture
def asked(monkeypatch):
    """What the command asks of the simulator, which is not run."""
    calls = []

    def load(name, **options):
        calls.append((name, options))
        raise InputError(f"sequence {name}: asked for")

    monkeypatch.setattr(simulated, "load", load)
    return calls


def test_simulate_passes_its_options_on(tmp_path, capsys, asked):
    out = ["simulate", "--out", str(tmp_path)]
    assert main(out) == 1
    assert "sequence 00: asked for" in one_line_error(capsys)
    options = {"world": "street", "scale": "small", "frames": None, "seed": 0}
    assert asked.pop() == ("00", options | {"movers": True, "missing": True, "tilt": True})
    without = ["--without", "tilt", "--without", "missing"]
    assert main([*out, "--sequence", "a~2", "--world", "indoor", "--scale", "full", *without]) == 1
    options = {"world": "indoor", "scale": "full", "frames": None, "seed": 0}
    assert asked.pop() == ("a~2", options | {"movers": True, "missing": False, "tilt": False})


def test_simulate_writes_nothing_if_one_is_there(tmp_path, capsys, asked):
    (tmp_path / "sequences" / "05").mkdir(parents=True)
    assert main(["simulate", "--out", str(tmp_path), "--sequence", "00", "05"]) == 1
    assert "sequences/05: is there already; remove it" in one_line_error(capsys)
    assert main(["simulate", "--out", str(tmp_path), "--sequence", "00", "../05"]) == 1
    assert "sequence '../05': must be the name of a folder" in one_line_error(capsys)
    assert asked == []


def test_ctrl_c_gives_one_line(tmp_path, capsys, monkeypatch):
    def stop(name, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(simulated, "load", stop)
    assert main(["simulate", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err == "rcnn-odom: interrupted\n"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "--out"),
        (["--out", "x", "--frames", "1"], "'1' is not a whole number, 2 or more"),
        (["--out", "x", "--frames", "many"], "'many' is not a whole number"),
        (["--out", "x", "--seed", "abc"], "'abc' is not a whole number, 0 or more"),
        (["--out", "x", "--seed=-1"], "'-1' is not a whole number"),
        (["--out", "x", "--world", "moon"], "invalid choice: 'moon'"),
        (["--out", "x", "--without", "wheels"], "invalid choice: 'wheels'"),
        (["--out", "x", "--sequence"], "expected at least one argument"),
    ],
)
def test_wrong_usage_of_simulate(capsys, options, message):
    with pytest.raises(SystemExit) as exit_status:
        main(["simulate", *options])
    assert exit_status.value.code == 2
    assert message in capsys.readouterr().err


def test_as_a_module_of_python(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["rcnn-odom", "--help"])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_module("rcnn_odom.cli", run_name="__main__")
    assert stopped.value.code == 0
    assert "drift" in capsys.readouterr().out


def test_a_terminal_that_knows_ascii_alone(tmp_path):
    write_kitti(tmp_path / "wahrheit_ü.txt", straight(150))
    command = [sys.executable, "-m", "rcnn_odom.cli", "drift", "wahrheit_ü.txt", "fehlt_ü.txt"]
    environment = {**os.environ, "PYTHONPATH": str(SOURCE), "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith(r"rcnn-odom: error: fehlt_\xfc.txt: cannot be read")
    assert done.stderr.count("\n") == 1


def test_what_is_printed_to_be_copied_is_quoted(tmp_path, capsys):
    folder = tmp_path / "mine (ü)"
    assert main(["simulate", "--out", str(folder), "--frames", "2", "--sequence", "ä b"]) == 0
    printed = capsys.readouterr().out.strip()
    words = shlex.split(printed)
    assert str(folder) in [word.rstrip(";") for word in words]
    overrides = OverridesParser.create().parse_overrides(words[words.index("evaluate") + 1 :])
    assert {override.key_or_group: override.value() for override in overrides[:3]} == {
        "data": "kitti",
        "data.root": str(folder),
        "data.test": ["ä b"],
    }


@pytest.mark.parametrize("content", [b"", b"no network\n"])
def test_what_is_no_checkpoint_gives_one_short_line(tmp_path, capsys, content):
    path = tmp_path / "checkpoints" / "best.ckpt"
    path.parent.mkdir()
    path.write_bytes(content)
    (tmp_path / "log").touch()
    for arguments in (
        ["export", str(path), "--no-drift"],
        ["run", str(tmp_path / "log"), "--model", str(path), "--out", str(tmp_path / "out")],
    ):
        assert main(arguments) == 1
        error = one_line_error(capsys)
        assert "not a checkpoint; give RUN/checkpoints/best.ckpt of a run" in error
        assert len(error) < len(str(path)) + 100
