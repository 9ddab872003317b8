"""New worlds for every epoch: the right ones, the same however they are reached, and ended with training."""

import subprocess
import sys
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import relative_steps
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.cache import encode_recordings
from rcnn_odom.training import fresh_worlds
from rcnn_odom.training.datamodule import OdometryDataModule
from rcnn_odom.training.fresh_worlds import FreshWorlds
from recordings.test_cache import running, wait_for
from stub_drives import load

torch.set_num_threads(1)
SENSOR = Sensor(1.0, 180.0, 40.0)
NAMES = ["00", "02"]


@pytest.fixture(scope="module")
def training_set(tmp_path_factory):
    return encode_recordings([load(name) for name in NAMES], SENSOR, tmp_path_factory.mktemp("cache"), 1)


@pytest.fixture
def make_worlds(training_set, tmp_path):
    made = []

    def make_worlds(epochs=4, workers=1, **options):
        folder = tmp_path / f"worlds{len(made)}"
        made.append(FreshWorlds(partial(load, **options), training_set, epochs, SENSOR, workers, folder))
        return made[-1]

    yield make_worlds
    for worlds in made:
        worlds.close()


def test_kept_worlds_are_the_same_and_made_once(training_set, tmp_path):
    fresh = FreshWorlds(load, training_set, 3, SENSOR, 1, tmp_path / "passing")
    keeping = FreshWorlds(load, training_set, 3, SENSOR, 1, tmp_path, keep=True)
    again = FreshWorlds(unreadable_scans, training_set, 3, SENSOR, 1, tmp_path, keep=True)
    try:
        for epoch in (1, 2):
            for expected, kept in zip(fresh.drives_of(epoch), keeping.drives_of(epoch), strict=True):
                np.testing.assert_array_equal(kept.scans, expected.scans)
                np.testing.assert_array_equal(kept.poses, expected.poses)
        # Another training finds them all, and starts no process.
        assert [drive.name for drive in again.drives_of(1)] == [f"{name}~1" for name in NAMES]
        assert again._workers is None
    finally:
        for worlds in (fresh, keeping, again):
            worlds.close()


def unreadable_scans(name):
    def read_scan(frame):
        raise AssertionError(f"{name} should come from the cache")

    return replace(load(name), read_scan=read_scan)


def processes(worlds):
    return [process for process in worlds._workers._processes if process.is_alive()]


def test_epoch_has_the_drives_of_its_number(make_worlds, training_set):
    worlds = make_worlds()
    assert worlds.drives_of(0) == training_set
    for epoch in (1, 2, 3):
        drives = worlds.drives_of(epoch)
        assert [drive.name for drive in drives] == [f"{name}~{epoch}" for name in NAMES]
        for drive in drives:
            recording = load(drive.name)
            direct = [SENSOR.encode(recording.read_scan(frame)) for frame in range(len(recording))]
            np.testing.assert_array_equal(drive.scans, direct)
            np.testing.assert_array_equal(drive.steps, relative_steps(recording.poses))


def test_epoch_is_the_same_for_a_resumed_run_and_any_number_of_workers(make_worlds):
    slow, resumed = make_worlds(workers=1), make_worlds(workers=3)
    for epoch in (0, 1):
        slow.drives_of(epoch)
    for epoch in (2, 2, 3):  # asked twice, it is the same
        for one, other in zip(slow.drives_of(epoch), resumed.drives_of(epoch), strict=True):
            assert one.name == other.name
            np.testing.assert_array_equal(one.scans, other.scans)
            np.testing.assert_array_equal(one.steps, other.steps)


def test_only_the_present_and_the_next_epoch_are_kept_and_none_after_the_last(make_worlds):
    worlds = make_worlds(epochs=3)
    kept = []
    for epoch in range(3):
        worlds.drives_of(epoch)
        for made in worlds._made.values():
            made.result()
        kept.append(sorted(path.name.split("-")[0] for path in worlds.folder.glob("*.npy")))
    assert kept == [["00~1", "02~1"], ["00~1", "00~2", "02~1", "02~2"], ["00~2", "02~2"]]
    alone = make_worlds(epochs=1)
    alone.drives_of(0)
    assert alone._workers is None


def test_time_for_which_training_waits_is_measured(make_worlds, monkeypatch):
    worlds = make_worlds(seconds=0.005)
    # A clock that goes on when worlds are ready.
    clock = SimpleNamespace(monotonic=lambda: sum(made.done() for made in worlds._made.values()))
    monkeypatch.setattr(fresh_worlds, "time", clock)
    worlds.drives_of(0)
    assert worlds.waited == 0
    worlds.drives_of(1)
    assert worlds.waited == 1
    worlds._made[2].result()
    worlds.drives_of(2)
    assert worlds.waited == 0


def test_drive_that_cannot_be_made_stops_training(make_worlds):
    worlds = make_worlds(broken="02~1")
    worlds.drives_of(0)
    with pytest.raises(InputError, match="02~1: frame 20 is damaged"):
        worlds.drives_of(1)


def test_closing_ends_the_workers_at_once(make_worlds):
    worlds = make_worlds(workers=2, seconds=10)
    worlds.drives_of(0)
    assert len(processes(worlds)) == 2
    made = worlds._made[1]
    worlds.close()
    assert processes(worlds) == []
    assert made.cancelled() or made.exception(), "it would take minutes to make them"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="finds the processes in /proc")
def test_workers_end_when_their_parent_is_killed(tmp_path):
    script = tmp_path / "wait.py"
    script.write_text("""
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from stub_drives import load
from rcnn_odom.recordings.cache import encode_recordings
from rcnn_odom.training.fresh_worlds import FreshWorlds
from rcnn_odom.models.encoding import Sensor
if __name__ == "__main__":
    drives = encode_recordings([load("00")], Sensor(), Path("cache"), 1)
    FreshWorlds(partial(load, seconds=0.01), drives, 1000, Sensor(), 2, Path("worlds")).drives_of(0)
    print("made", flush=True)
    time.sleep(60)
""")
    environment = {"PYTHONPATH": ":".join(sys.path)}
    parent = subprocess.Popen(
        [sys.executable, str(script)],
        start_new_session=True,
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout.readline() == "made\n"
    wait_for(lambda: len(running(parent.pid)) == 4)  # with Python's resource tracker
    parent.kill()
    parent.wait()
    wait_for(lambda: not running(parent.pid))


# --- in the DataModule ---------------------------------------------------------------------------


def make_module(folder, train=NAMES, fresh_epochs=3, **options):
    options = {"workers": 1, "fresh_epochs": fresh_epochs, "worlds_dir": folder / "worlds", **options}
    return OdometryDataModule(load, list(train), ["10"], ["05"], SENSOR, folder, **options)


@pytest.mark.parametrize("window", [1, 16])
def test_batches_of_an_epoch_come_from_its_worlds(tmp_path, window):
    fresh = make_module(tmp_path, window=window, batch_size=4).load()
    fixed = make_module(tmp_path, window=window, batch_size=4, fresh_epochs=0).load()
    steps = fresh.training_steps()
    fresh_loader, fixed_loader = fresh.train_dataloader(), fixed.train_dataloader()
    try:
        for epoch in range(3):
            for loader in (fresh_loader, fixed_loader):
                loader.batch_sampler.sampler.set_epoch(epoch)
            if epoch:  # the same draws, out of other drives
                fixed_loader.dataset.drives = encode_recordings(
                    [load(f"{name}~{epoch}") for name in NAMES], SENSOR, tmp_path / "other", 1
                )
            batches = list(zip(fresh_loader, fixed_loader, strict=True))
            assert len(batches) == len(fresh_loader)
            for one, other in batches:
                assert torch.equal(one["pairs"], other["pairs"])
                assert torch.equal(one["steps"], other["steps"])
        for before, now in zip(steps, fresh.training_steps(), strict=True):
            np.testing.assert_array_equal(before, now)
        assert [drive.name for drive in fresh.drives["train"]] == NAMES
        assert len(list(tmp_path.glob("*.npy"))) == 4
    finally:
        fresh.close()
    assert not (tmp_path / "worlds").exists(), "what is new goes away"


def test_part_of_a_drive_has_no_new_worlds(tmp_path):
    with pytest.raises(InputError, match=r"data.train=00\[:0.5\]: new worlds come as whole drives"):
        make_module(tmp_path, train=["00[:0.5]"]).load()
    assert len(make_module(tmp_path, train=["00[:0.5]"], fresh_epochs=0).load().drives["train"][0]) == 75


MEMORY = """
import sys
from functools import partial
from pathlib import Path
from rcnn_odom.recordings.cache import encode_recordings
from rcnn_odom.training.datamodule import OdometryDataModule
from rcnn_odom.models.encoding import Sensor
from stub_drives import load
if __name__ == "__main__":
    names = [f"{number:03d}" for number in range(int(sys.argv[1]))]
    folder = Path(sys.argv[2])
    options = {"workers": 1, "fresh_epochs": 2, "worlds_dir": folder / "worlds"}
    drives = partial(load, frames=150)
    data = OdometryDataModule(drives, names, ["10"], ["05"], Sensor(), folder, **options).load()
    loader = data.train_dataloader()
    for epoch in range(2):
        loader.batch_sampler.sampler.set_epoch(epoch)
        for batch in loader:
            pass
    status = Path("/proc/self/status").read_text()
    print(next(int(line.split()[1]) for line in status.splitlines() if line.startswith("RssAnon")))
    data.close()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the memory from /proc")
@pytest.mark.slow
def test_memory_does_not_grow_with_the_drives(tmp_path):
    script = tmp_path / "memory.py"
    script.write_text(MEMORY)
    environment = {"PYTHONPATH": ":".join(sys.path), "OMP_NUM_THREADS": "1"}
    used = [
        int(
            subprocess.run(
                [sys.executable, str(script), str(drives), str(tmp_path / str(drives))],
                env=environment,
                stdout=subprocess.PIPE,
                check=True,
                timeout=120,
            ).stdout
        )
        for drives in (4, 24)
    ]
    # In memory, 20 drives of 150 scans of 14 kB would be 43 MB.
    assert used[1] - used[0] < 15_000, used
