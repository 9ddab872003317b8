"""Recordings of several formats and lasers in one training: names, lasers that are a part of the sensor."""

import numpy as np
import pytest

from conftest import LENGTHS
from data.make_carmen import make_carmen
from data.make_kitti import make_kitti
from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings import carmen, mixed, simulated
from rcnn_odom.recordings.beams import PATIENCE, BeamCheck
from rcnn_odom.recordings.cache import encode_recordings
from rcnn_odom.recordings.formats import open_recording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.training import stages
from rcnn_odom.training.settings import plain
from train import train

WIDE = Sensor(0.25, 270.0, 40.0)
INDOOR = {"format": "simulated", "world": "indoor", "frames": 40, "laser": {"kind": "sick"}, "partial": True}


@pytest.fixture(scope="module")
def log_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    make_carmen(folder, "robot", beams=180)
    make_carmen(folder, "fine", frames=30, beams=361, seed=1)
    return folder


def sources_of(folder, **options):
    return {"logs": {"format": "carmen", "root": str(folder), **options}, "rooms": INDOOR}


def even(first, spacing, count, distance=5.0):
    return Scan(np.full(count, distance), np.deg2rad(first + spacing * np.arange(count)))


# --- names ---------------------------------------------------------------------------------------


def test_a_recording_is_its_sources_own_under_a_longer_name(log_folder):
    sources = sources_of(log_folder)
    log = mixed.load("logs/robot", sources=sources)
    own = carmen.load("robot", root=log_folder)
    assert (log.name, own.name, log.fingerprint) == ("logs/robot", "robot", own.fingerprint)
    np.testing.assert_array_equal(log.poses, own.poses)
    np.testing.assert_array_equal(log.read_scan(7).ranges, own.read_scan(7).ranges)
    assert (log.keeps_world, log.has_partial_laser) == (True, False)
    rooms = mixed.load("rooms/00~1", sources=sources)
    same = simulated.load("00~1", world="indoor", frames=40, laser={"kind": "sick"})
    np.testing.assert_array_equal(rooms.read_scan(3).ranges, same.read_scan(3).ranges)
    assert (rooms.keeps_world, rooms.has_partial_laser) == (False, True)
    assert rooms.fingerprint != same.fingerprint, "other scans fit"


@pytest.mark.parametrize(
    ("name", "changes", "says"),
    [
        ("robot", {}, "sequence robot: must be SOURCE/NAME with one of the sources logs, rooms"),
        ("log/robot", {}, "sequence log/robot: must be SOURCE/NAME with one of the sources"),
        ("logs/", {}, "must be SOURCE/NAME with one of the sources"),
        ("logs/none", {}, r"data.sources.logs: .*none: no such file"),
        ("logs/robot", {"format": "karmen"}, "data.sources.logs: .*karmen"),
        (
            "logs/robot",
            {"speed": 3},
            "data.sources.logs: got an unexpected keyword argument 'speed'; carmen has",
        ),
        ("logs/robot", {"partial": "maybe"}, "data.sources.logs.partial=maybe: must be true or false"),
    ],
)
def test_what_is_wrong_with_a_source_is_told_in_one_line(log_folder, name, changes, says):
    with pytest.raises(InputError, match=says) as refusal:
        mixed.load(name, sources=sources_of(log_folder, **changes))
    assert "\n" not in str(refusal.value)


# --- a laser that is a part of the sensor --------------------------------------------------------


@pytest.mark.parametrize(
    "scan",
    [
        even(-90, 1, 181),
        even(-90, 1, 180),
        even(90, -1, 181),
        even(-90, 0.5, 361),
        even(-135, 0.25, 1081),
        even(-120, 4, 61),
        even(0, 1, 90),
    ],
)
def test_a_part_of_the_sensor_fits_where_the_user_says_so(scan):
    assert BeamCheck(WIDE, partly=True)(scan) == ""


@pytest.mark.parametrize(
    ("scan", "says"),
    [
        (even(-180, 1, 360), "no part of the sensor's from -135 to 135 degrees"),
        (even(0, 1, 181), "no part of the sensor's"),
        (even(-90, 0.05, 3601), "one every 0.05, which is no part"),
        (even(-90, 12, 16), "one every 12, which is no part"),
        (Scan(np.full(181, 5.0), np.arange(-90.0, 91.0)), "as if its angles were not in radians"),
        (even(-90, 1, 181, np.linspace(500, 39000, 181)), "cannot be metres"),
        (Scan(np.ones(1), np.zeros(1)), "a single beam"),
    ],
)
def test_other_mistakes_are_still_found(scan, says):
    assert says in BeamCheck(WIDE, partly=True)(scan)


def test_without_the_users_word_a_part_is_refused(log_folder, tmp_path):
    log = mixed.load("logs/robot", sources=sources_of(log_folder))
    with pytest.raises(
        InputError, match=r"logs/robot: frame .*set data.sensor.field_of_view_deg=180"
    ) as told:
        encode_recordings([log], WIDE, tmp_path, 1)
    assert "\n" not in str(told.value)
    assert BeamCheck(WIDE)(log.read_scan(0))
    assert len(log) > PATIENCE


def test_lasers_of_several_kinds_go_into_one_sensor(log_folder, tmp_path):
    sources = sources_of(log_folder, partial=True)
    recordings = [mixed.load(name, sources=sources) for name in ("logs/robot", "logs/fine", "rooms/05")]
    drives = encode_recordings(recordings, WIDE, tmp_path, 1)
    for drive, gap in zip(drives, (4, 2, 4), strict=True):
        filled = np.flatnonzero(drive.scans.any(0))
        bearings = WIDE.first_bin_deg + filled * WIDE.resolution_deg
        assert bearings.min() == pytest.approx(-90, abs=0.3)
        assert bearings.max() == pytest.approx(90, abs=1.3)
        assert np.median(np.diff(np.flatnonzero(drive.scans[5]))) == gap
        read = WIDE.encode(recordings[drives.index(drive)].read_scan(5))
        np.testing.assert_array_equal(drive.scans[5], read)


# --- a training ----------------------------------------------------------------------------------


@pytest.fixture
def options(log_folder):
    return [
        "data=mixed",
        f"data.sources.logs.root={log_folder}",
        "+data.sources.sick.frames=40",
        "+data.sources.fine_sick.frames=40",
        "data.train=[sick/00,fine_sick/03,'logs/robot[:0.7]',logs/fine]",
        "data.val=[sick/10,'logs/robot[0.7:]']",
        "data.test=[logs/fine,fine_sick/05]",
        LENGTHS,
    ]


def test_logs_and_simulated_worlds_train_together(configure, options, tmp_path):
    metrics = train(configure("model=cnn_reg", *options, "data.augment.beam_pattern=[1,3]", "model.epochs=2"))
    assert set(metrics["test"]["sequences"]) == {"logs/fine", "fine_sick/05"}
    assert metrics["data"] == "mixed"
    names = {path.name for path in (tmp_path / "outputs" / "run" / "trajectories").iterdir()}
    assert {"logs_fine.txt", "fine_sick_05.txt"} <= names


def test_new_worlds_take_the_place_of_simulated_drives_alone(configure, options):
    settings = plain(configure("model=cnn_reg", *options))
    data = stages.build_datamodule(settings).load(("train",))
    loader = data.train_dataloader()
    try:
        first = data.worlds.drives_of(0)
        second = data.worlds.drives_of(1)
        assert [drive.name for drive in first] == ["sick/00", "fine_sick/03", "logs/robot[:0.7]", "logs/fine"]
        assert [drive.name for drive in second] == [
            "sick/00~1",
            "fine_sick/03~1",
            "logs/robot[:0.7]",
            "logs/fine",
        ]
        assert second[2:] == first[2:]
        assert (second[0].scans != first[0].scans).any()
        loader.batch_sampler.sampler.set_epoch(1)
        assert len(list(loader)) == len(loader) == data.batches_per_epoch
    finally:
        data.close()


def test_a_part_of_a_simulated_drive_has_no_new_worlds(configure, options):
    options += ["data.train=['sick/00[:0.5]',logs/fine]"]
    data = stages.build_datamodule(plain(configure("model=cnn_reg", *options)))
    with pytest.raises(InputError, match=r"data.train=sick/00\[:0.5\]: new worlds come as whole drives"):
        data.load(("train",))
    fixed = stages.build_datamodule(plain(configure("model=cnn_reg", *options, "data.fresh_worlds=false")))
    assert len(fixed.load(("train",)).drives["train"][0]) == 20


def test_logs_alone_need_no_workers(configure, options):
    options += ["data.train=[logs/fine,logs/robot]"]
    data = stages.build_datamodule(plain(configure("model=cnn_reg", *options))).load(("train",))
    data.train_dataloader()
    try:
        assert data.worlds.drives_of(1) == data.worlds.drives_of(0) == data.drives["train"]
        assert data.worlds._workers is None
    finally:
        data.close()


def test_kitti_and_streets_train_together(tmp_path):
    make_kitti(tmp_path, frames=12)
    sources = {
        "kitti": {"format": "kitti", "root": str(tmp_path)},
        "street": {"format": "simulated", "frames": 10},
    }
    opened = open_recording({"format": "mixed", "sources": sources})
    recordings = [opened("kitti/00"), opened("street/00"), opened("street/00~1")]
    drives = encode_recordings(recordings, Sensor(), tmp_path / "cache", 1)
    assert [drive.scans.shape for drive in drives] == [(12, 3601), (10, 3601), (10, 3601)]
    assert [drive.keeps_world for drive in drives] == [True, False, False]


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("data.sources=3", "data.sources=3: must be readers by their names"),
        ("data.sources={a: {root: x}}", "must be readers by their names, each with its format and options"),
        ("data.root=x", "data.root"),
    ],
)
def test_sources_that_are_none_are_refused(configure, options, override, says):
    override = override if override == "data.sources=3" else f"+{override}"
    with pytest.raises(InputError, match=says) as refusal:
        plain(configure("model=cnn_reg", *options, override))
    assert "\n" not in str(refusal.value)


def test_the_folder_of_the_logs_must_be_given(configure):
    with pytest.raises(InputError, match=r"data.sources.logs.root is missing; give it on the command line"):
        plain(configure("model=cnn_reg", "data=mixed"))
