"""Encoded scans: equal to direct encoding, read back without the reader, complete or absent."""

import os
import resource
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, planar_to_poses
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.cache import cache_path, encode_recordings
from rcnn_odom.recordings.recording import Drive, Recording
from rcnn_odom.recordings.scan import Scan

SENSOR = Sensor(1.0, 180.0, 40.0)
FRAMES = 150
"""More than two of the blocks in which workers encode."""


@dataclass(frozen=True)
class Reader:
    """Random scans; leaves a file for each frame that was read, and fails at one of them."""

    seed: int
    calls: Path
    broken: int = -1

    def __call__(self, frame):
        (self.calls / f"{self.seed}-{frame}").touch()
        if frame == self.broken:
            raise InputError(f"frame {frame}: damaged; copy it again")
        return scan(self.seed, frame)


def scan(seed, frame):
    rng = np.random.default_rng([seed, frame])
    bearings = rng.uniform(-np.pi, np.pi, 300)
    return Scan(rng.uniform(0, 50, 300), bearings, has_all_beams=False)


@pytest.fixture
def calls(tmp_path):
    folder = tmp_path / "calls"
    folder.mkdir()
    return folder


def make_sequence(calls, seed=0, frames=FRAMES, **options):
    planar = np.stack([np.arange(frames) * 0.5, np.zeros(frames), np.zeros(frames)], axis=1)
    return Recording(
        name=f"drive{seed}",
        poses=planar_to_poses(planar),
        stamps=np.arange(frames, dtype=np.float64),
        read_scan=Reader(seed, calls, **options),
        fingerprint=f"print{seed}",
        wheel_odometry=planar_to_poses(planar * 1.1),
    )


def direct(seed, frames=FRAMES, sensor=SENSOR):
    return np.stack([sensor.encode(scan(seed, frame)) for frame in range(frames)])


def files(folder):
    """All but the lock by which processes take turns, which stays."""
    return sorted(path.name for path in folder.iterdir() if path.suffix != ".lock")


def test_two_workers_give_what_direct_encoding_gives(tmp_path, calls):
    sequences = [make_sequence(calls, 0), make_sequence(calls, 1, frames=3)]
    first, second = encode_recordings(sequences, SENSOR, tmp_path / "deep" / "cache", workers=2)
    np.testing.assert_array_equal(first.scans, direct(0))
    np.testing.assert_array_equal(second.scans, direct(1, 3))
    assert (first.name, second.name) == ("drive0", "drive1")
    assert len(first) == FRAMES
    for name in ("poses", "stamps", "camera_from_laser", "wheel_odometry"):
        np.testing.assert_array_equal(getattr(first, name), getattr(sequences[0], name))
    assert len(files(calls)) == FRAMES + 3
    assert len(files(tmp_path / "deep" / "cache")) == 2


def test_second_call_reads_the_file_and_no_scan(tmp_path, calls):
    cache = tmp_path / "cache"
    [before] = encode_recordings([make_sequence(calls)], SENSOR, cache, workers=1)
    for path in calls.iterdir():
        path.unlink()
    [after] = encode_recordings([make_sequence(calls, broken=5)], SENSOR, cache, workers=1)
    assert files(calls) == []
    assert after.key == before.key
    np.testing.assert_array_equal(after.scans, direct(0))
    # A map of the file, which nobody can write to.
    assert isinstance(after.scans, np.memmap)
    assert not after.scans.flags.writeable


@pytest.mark.parametrize("place", [0, 9, 200, -40, -1])
def test_damaged_file_is_noticed_and_encoded_again(tmp_path, calls, caplog, place):
    cache = tmp_path / "cache"
    encode_recordings([make_sequence(calls)], SENSOR, cache, workers=1)
    [path] = cache.glob("*.npy")
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    [again] = encode_recordings([make_sequence(calls)], SENSOR, cache, workers=1)
    np.testing.assert_array_equal(again.scans, direct(0))
    assert f"{path}: damaged" in caplog.text
    content[place] ^= 1
    assert path.read_bytes() == content


@pytest.mark.parametrize("bytes_left", [0, 10, 500, -1])
def test_cut_off_file_is_noticed_and_encoded_again(tmp_path, calls, caplog, bytes_left):
    cache = tmp_path / "cache"
    encode_recordings([make_sequence(calls)], SENSOR, cache, workers=1)
    [path] = cache.glob("*.npy")
    path.write_bytes(path.read_bytes()[:bytes_left])
    [again] = encode_recordings([make_sequence(calls)], SENSOR, cache, workers=1)
    np.testing.assert_array_equal(again.scans, direct(0))
    assert f"{path}: damaged" in caplog.text


def test_only_what_is_missing_is_encoded(tmp_path, calls):
    cache = tmp_path / "cache"
    encode_recordings([make_sequence(calls, 0, frames=4)], SENSOR, cache, workers=1)
    sequences = [make_sequence(calls, 1, frames=3), make_sequence(calls, 0, frames=4, broken=2)]
    first, second = encode_recordings(sequences, SENSOR, cache, workers=1)
    np.testing.assert_array_equal(first.scans, direct(1, 3))
    np.testing.assert_array_equal(second.scans, direct(0, 4))


def test_key_changes_with_all_that_changes_the_scans(tmp_path, calls):
    sequence = make_sequence(calls)
    others = [
        (sequence, Sensor(0.5, 180.0, 40.0)),
        (sequence, Sensor(1.0, 90.0, 40.0)),
        (sequence, Sensor(1.0, 180.0, 30.0)),
        (replace(sequence, fingerprint="another"), SENSOR),
        (replace(sequence, name="another"), SENSOR),
        (make_sequence(calls, frames=FRAMES - 1), SENSOR),
    ]
    paths = {cache_path(sequence, SENSOR, tmp_path)}
    paths |= {cache_path(other, sensor, tmp_path) for other, sensor in others}
    assert len(paths) == 1 + len(others)


def test_key_does_not_change_with_the_truth(tmp_path, calls):
    sequence = make_sequence(calls)
    other = replace(sequence, poses=sequence.poses + 1, read_scan=Reader(9, calls), notes=("note",))
    assert cache_path(sequence, SENSOR, tmp_path) == cache_path(other, SENSOR, tmp_path)


def test_stopped_encoding_leaves_nothing(tmp_path, calls):
    cache = tmp_path / "cache"
    with pytest.raises(InputError, match="frame 140: damaged"):
        encode_recordings([make_sequence(calls, broken=140)], SENSOR, cache, workers=2)
    assert files(calls)
    assert files(cache) == []
    [encoded] = encode_recordings([make_sequence(calls)], SENSOR, cache, workers=1)
    np.testing.assert_array_equal(encoded.scans, direct(0))


def test_partial_file_of_a_killed_process_is_not_believed(tmp_path, calls):
    cache = tmp_path / "cache"
    cache.mkdir()
    sequence = make_sequence(calls, frames=5)
    path = cache_path(sequence, SENSOR, cache)
    left = cache / f".{path.stem}.{os.getpid() + 1}.partial"
    left.write_bytes(b"\x93NUMPY truncated")
    [encoded] = encode_recordings([sequence], SENSOR, cache, workers=1)
    np.testing.assert_array_equal(encoded.scans, direct(0, 5))
    assert path.name in files(cache)


def test_full_disk_is_told_in_a_line_and_leaves_nothing_of_what_did_not_fit(tmp_path, calls):
    cache = tmp_path / "cache"
    sequences = [make_sequence(calls, 0, frames=4), make_sequence(calls, 1), make_sequence(calls, 2)]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, hard))
    try:
        with pytest.raises(
            InputError, match=r"0 MB of encoded scans cannot be written \(.+\); make room"
        ) as e:
            encode_recordings(sequences, SENSOR, cache, workers=2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(e.value)
    assert set(files(cache)) <= {cache_path(sequences[0], SENSOR, cache).name}
    for seed, encoded in enumerate(encode_recordings(sequences, SENSOR, cache, workers=2)):
        np.testing.assert_array_equal(encoded.scans, direct(seed, len(encoded)))


def test_result_does_not_depend_on_the_number_of_workers(tmp_path, calls):
    sequences = [make_sequence(calls, seed, frames=30 + 50 * seed) for seed in range(4)]
    one, three = (encode_recordings(sequences, SENSOR, tmp_path / str(n), workers=n) for n in (1, 3))
    assert [drive.key for drive in one] == [drive.key for drive in three]
    for name in files(tmp_path / "1"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "3" / name).read_bytes()


def test_part_is_a_view_of_the_same_frames():
    frames = 10
    planar = np.stack([np.arange(frames) ** 2 / 10, np.zeros(frames), np.zeros(frames)], axis=1)
    scans = np.arange(frames * 3, dtype=np.float32).reshape(frames, 3)
    whole = Drive(
        "drive",
        "key",
        scans,
        planar_to_poses(planar),
        np.arange(10.0),
        FORWARD_CAMERA,
        planar_to_poses(planar),
    )
    np.testing.assert_allclose(whole.motions[:, 0], np.diff(np.arange(frames) ** 2) / 10)
    part = whole.part(2, 6, "drive[0.2:0.6]")
    assert (part.name, len(part)) == ("drive[0.2:0.6]", 4)
    assert np.shares_memory(part.scans, whole.scans)
    np.testing.assert_array_equal(part.scans, scans[2:6])
    np.testing.assert_array_equal(part.stamps, [2, 3, 4, 5])
    np.testing.assert_array_equal(part.wheel_odometry, whole.wheel_odometry[2:6])
    np.testing.assert_allclose(part.motions[:, 0], [0.5, 0.7, 0.9])
    assert whole.part(0, 3).name == "drive"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="finds the processes in /proc")
def test_workers_end_when_their_parent_is_killed(tmp_path):
    folder, script = tmp_path / "cache", tmp_path / "encode.py"
    script.write_text(f"""
from functools import partial
from pathlib import Path
from rcnn_odom.recordings.cache import encode_recordings
from rcnn_odom.models.encoding import Sensor
from stub_drives import load
if __name__ == "__main__":
    encode_recordings([load("00", seconds=0.01, frames=20_000)], Sensor(), Path({str(folder)!r}), 2)
""")
    environment = {"PYTHONPATH": ":".join(sys.path)}
    parent = subprocess.Popen([sys.executable, str(script)], start_new_session=True, env=environment)
    # Itself, two workers and Python's resource tracker; a worker that has not begun ends by itself.
    wait_for(lambda: len(running(parent.pid)) == 4)
    wait_for(lambda: list(folder.glob(".*.partial")))
    time.sleep(0.5)
    parent.kill()
    parent.wait()
    wait_for(lambda: not running(parent.pid))
    assert not list(folder.glob("*.npy"))


def running(session):
    """Processes of a session, which orphans stay in, that are not just waiting to be buried."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of_process, *_ = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(of_process) == session and state != "Z":
            found.append(stat.parent.name)
    return found


def wait_for(condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.1)


@dataclass(frozen=True)
class Sick:
    """Scans of an even wall all round a laser whose beams are, for some frames, those of another."""

    others: frozenset[int]
    degrees: tuple[float, ...]

    def __call__(self, frame):
        degrees = self.degrees if frame in self.others else np.arange(-90.0, 91.0)
        return Scan(np.full(len(degrees), 5.0), np.deg2rad(degrees))


RIGHT_HALF = tuple(np.arange(-90.0, 1.0))


def sick(frames, others, degrees=RIGHT_HALF):
    return replace(make_sequence(Path(), frames=frames), read_scan=Sick(frozenset(others), degrees))


def test_single_scans_of_other_beams_have_no_returns(tmp_path):
    others = [0, 1, 50, 149]
    (drive,) = encode_recordings([sick(150, others)], SENSOR, tmp_path, workers=2)
    assert [frame for frame in range(150) if not drive.scans[frame].any()] == others
    np.testing.assert_allclose(drive.scans[2], 5.0)


@pytest.mark.parametrize(("frames", "others"), [(150, range(150)), (150, range(100, 150)), (3, range(3))])
@pytest.mark.parametrize(
    ("degrees", "says"),
    [
        (
            np.arange(-90.0, 1.0),
            "its beams lie from -90 to 0 degrees, one every 1, but the sensor's lie from -90 to 90",
        ),
        (np.arange(0.0, 180.0), "set data.sensor.field_of_view_deg=180 .* data.sensor.facing_deg=90"),
        (np.rad2deg(np.arange(-90.0, 91.0)), "more than a circle, as if its angles were not in radians"),
    ],
)
def test_a_recording_of_another_laser_is_refused(tmp_path, frames, others, degrees, says):
    with pytest.raises(InputError, match=says) as refused:
        encode_recordings([sick(frames, others, tuple(degrees))], SENSOR, tmp_path / "cache", workers=1)
    assert str(refused.value).startswith("drive0: frame " if frames > 3 else "drive0: 3 of frames 0 to 2: ")
    assert not list((tmp_path / "cache").glob("*.npy"))


def test_a_recording_of_which_most_scans_are_anothers_is_refused(tmp_path):
    most = [frame for frame in range(150) if frame % 5]
    with pytest.raises(InputError, match="drive0: 51 of frames 0 to 63: its beams lie from -90 to 0 degrees"):
        encode_recordings([sick(150, most)], SENSOR, tmp_path, workers=1)
