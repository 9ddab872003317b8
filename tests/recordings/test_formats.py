"""Formats by their names: the project's own, and one that another package adds by an entry point."""

import os
import sys
from pathlib import Path

import pytest

import stub_drives
from data.make_carmen import make_carmen
from rcnn_odom.errors import InputError
from rcnn_odom.recordings import carmen, kitti
from rcnn_odom.recordings.formats import all_formats, find_format, open_recording, open_stream


@pytest.fixture
def add(tmp_path, monkeypatch):
    """Installs a package with a recording format ``toy`` out of the source of its module."""
    monkeypatch.syspath_prepend(tmp_path / "site")

    def add(source, name="toy"):
        info = tmp_path / "site" / "toy-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[rcnn_odom.recording_formats]\n{name} = toy_format\n")
        (tmp_path / "site" / "toy_format.py").write_text(source)
        monkeypatch.delitem(sys.modules, "toy_format", raising=False)

    return add


STREAMS = """
from rcnn_odom.recordings.stream import ScanStream

def recognises(path):
    return path.suffix == ".log"

def stream(path, ring=None):
    return ScanStream(f"toy {ring}", iter(()))
"""


def test_own_formats_and_an_added_one():
    formats = all_formats()
    assert set(formats) == {
        *("kitti", "kitti_raw", "carmen", "rosbag", "json_lines", "simulated", "logs", "mixed"),
        "stub_drives",
    }
    assert (find_format("kitti"), find_format("stub_drives")) == (kitti, stub_drives)


def test_a_recording_by_its_format_and_options(tmp_path):
    make_carmen(tmp_path, "robot", frames=4)
    load = open_recording({"format": "carmen", "root": tmp_path, "max_range": 40.0})
    assert load("robot").fingerprint == carmen.load("robot", root=tmp_path).fingerprint
    assert open_recording({"format": "stub_drives", "seed": 3})("00").fingerprint == "00 3 150"


@pytest.mark.parametrize(
    ("reader", "says"),
    [
        (
            {"format": "cartographer"},
            "no recording format is called cartographer; there are carmen, json_lines, ",
        ),
        ({"format": None}, "no recording format is called None"),
        ({}, "no recording format is called None"),
        ({"format": "rosbag"}, "rosbag has no load"),
        (
            {"format": "kitti", "root": "x", "rings": 3},
            "unexpected keyword argument 'rings'; kitti has name, ",
        ),
        ({"format": "kitti"}, "missing a required argument: 'root'; kitti has name, root, ring"),
    ],
)
def test_mistakes_are_one_line(reader, says):
    with pytest.raises(InputError, match=says) as raised:
        open_recording(reader)
    assert "\n" not in str(raised.value)


def test_an_added_format_is_asked_first_and_given_its_options(tmp_path, add, caplog):
    make_carmen(tmp_path, "robot", frames=4)
    options = {"topic": "/scan", "ring": 2, "field_of_view_deg": None}
    assert open_stream(tmp_path / "robot.log", options).name == "robot.log"
    for option in ("topic", "ring"):
        assert (
            f"robot.log: read as carmen, which has no option {option}; the option is ignored" in caplog.text
        )
    add(STREAMS)
    assert open_stream(tmp_path / "robot.log", options).name == "toy 2"
    assert open_stream(tmp_path / "robot.log").name == "toy None"
    with pytest.raises(InputError, match="toy has no load"):
        find_format("toy")


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("", "format toy has no recognises and no stream; it needs load, or"),
        ("load = 5", "format toy has no recognises and no stream; it needs load, or"),
        ("def stream(path): ...", "format toy has no recognises; it needs load, or recognises and stream"),
        ("def load(name): ...\ndef recognises(path): ...", "format toy has no stream; "),
        ("import nowhere_at_all", "format toy: toy_format cannot be imported .ModuleNotFoundError"),
    ],
)
def test_an_added_format_without_a_part(add, source, says):
    add(source)
    with pytest.raises(InputError, match=says) as raised:
        all_formats()
    assert "\n" not in str(raised.value)


def test_a_folder_of_ros1_bags_names_them(tmp_path):
    for name in ("b.bag", "a.BAG", "notes.txt"):
        (tmp_path / name).write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(InputError, match=r"give one of the bags in it: a\.BAG, b\.bag$"):
        open_stream(tmp_path)


def test_a_pipe_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/null")):
        with pytest.raises(InputError, match="is a pipe or device; give a file, or --live for JSON lines"):
            open_stream(path)


def test_two_formats_of_one_name(add):
    add(STREAMS, name="kitti")
    with pytest.raises(InputError, match="two recording formats are called kitti, one of them toy_format"):
        all_formats()
