"""How frames are dealt out to the processes that work on them."""

import os
import signal
import subprocess
import sys
from functools import partial
from itertools import chain

import numpy as np
import pytest

from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.cache import Encoding
from rcnn_odom.recordings.workers import CHUNK, ONE_THREAD, Workers, split_frames
from stub_drives import FRAMES, load

SENSOR = Sensor(1.0, 180.0, 40.0)
KITTI = [4541, 4661, 801, 271, 1101, 4071, 1591, 1201, 2761, 1101, 1101]
NAMES = ["00", "02", "10"]
LENGTHS = [FRAMES[name] for name in NAMES]


@pytest.mark.parametrize("workers", [1, 2, 3, 7, 64])
@pytest.mark.parametrize("lengths", [KITTI, [5], [1, 1, 1], [64, 128, 65]])
def test_every_frame_is_dealt_out_once_and_evenly(lengths, workers):
    shares = split_frames(lengths, workers)
    assert len(shares) == workers
    dealt = [(number, frame) for number, *ends in chain(*shares) for frame in range(*ends)]
    assert dealt == [(number, frame) for number, length in enumerate(lengths) for frame in range(length)]
    loads = [sum(stop - start for _, start, stop in pieces) for pieces in shares]
    assert max(loads) - min(loads) <= 1
    assert all(0 < stop - start <= CHUNK for _, start, stop in chain(*shares))


def test_worlds_are_built_once_except_where_two_workers_meet():
    worlds = [len({number for number, _, _ in pieces}) for pieces in split_frames(KITTI, 4)]
    assert sum(worlds) <= len(KITTI) + 3


def encoded(workers):
    scans = [np.full((length, SENSOR.bins), np.nan, np.float32) for length in LENGTHS]
    poses = [np.full((length, 4, 4), np.nan) for length in LENGTHS]
    for (number, start, stop), (some_scans, some_poses) in workers.run(NAMES, LENGTHS):
        scans[number][start:stop] = some_scans
        poses[number][start:stop] = some_poses
    return scans, poses


@pytest.mark.parametrize("count", [1, 3])
def test_workers_give_what_direct_encoding_gives_as_often_as_asked(count):
    with Workers(count, Encoding(load, SENSOR)) as workers:
        for _ in range(2):
            scans, poses = encoded(workers)
            for name, its_scans, its_poses in zip(NAMES, scans, poses, strict=True):
                direct = [SENSOR.encode(load(name).read_scan(frame)) for frame in range(FRAMES[name])]
                np.testing.assert_array_equal(its_scans, direct)
                np.testing.assert_array_equal(its_poses, load(name).poses)


def test_workers_have_one_thread_each_and_no_ear_for_ctrl_c():
    """In a new process, where Python's own helper starts with the first worker and meddles."""
    script = """
import os, signal
from rcnn_odom.recordings.workers import Workers
from test_workers import tell_environment
before = dict(os.environ)
with Workers(1, tell_environment) as workers:
    [(piece, told)] = workers.run(["00"], [1])
    print(told)
assert dict(os.environ) == before
assert not signal.pthread_sigmask(signal.SIG_BLOCK, [])
"""
    environment = {"PYTHONPATH": ":".join(sys.path), "OMP_NUM_THREADS": "7"}
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout == f"{['1'] * len(ONE_THREAD)} True\n"


def tell_environment(name, start, stop):
    deaf = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    return f"{[os.environ[name] for name in ONE_THREAD]} {deaf}"


def test_failure_of_a_reader_ends_the_workers_and_keeps_its_message():
    workers = Workers(2, Encoding(partial(load, broken="02"), SENSOR))
    with pytest.raises(InputError) as failure:
        encoded(workers)
    assert str(failure.value) == "02: frame 20 is damaged; copy it again"
    assert "in __call__" in failure.value.__notes__[0]
    assert not any(process.is_alive() for process in workers._processes)


@pytest.mark.parametrize("pieces_before", [0, 1])
def test_killed_worker_is_told_of(pieces_before):
    with Workers(2, Encoding(partial(load, seconds=0.01), SENSOR)) as workers:
        pieces = workers.run(NAMES, LENGTHS)
        for _ in range(pieces_before):
            next(pieces)
        workers._processes[0].kill()
        workers._processes[0].join()
        with pytest.raises(InputError, match=r"was killed.*data\.workers=1"):
            list(pieces)
