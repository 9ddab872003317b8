"""Training by processes that torchrun or Slurm has started: two "nodes" on one machine."""

import os
import re
import signal
import socket
import subprocess
import sys
import time

import pytest
import torch
from test_ddp import drift_of_one_process, uneven  # noqa: F401 - a fixture

from conftest import LENGTHS, ROOT, SMALL, SMALL_RECURRENT
from evaluate import evaluate
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import BEST, CONFIG, LAST, METRICS, read_metrics_file, read_settings
from rcnn_odom.training import cluster
from rcnn_odom.training.checkpoint import load_module
from rcnn_odom.training.cluster import World, find_world
from rcnn_odom.training.settings import plain
from rcnn_odom.training.trainer_options import check_devices, processes_per_node
from train import train

TORCHRUN = {"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "1"}
TORCHRUN |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "1"}
SLURM = {"SLURM_PROCID": "1", "SLURM_NTASKS": "2", "SLURM_LOCALID": "0", "SLURM_NTASKS_PER_NODE": "1"}
SLURM |= {"SLURM_NODEID": "1", "SLURM_NNODES": "2", "SLURM_STEP_ID": "0", "SLURM_JOB_NAME": "train"}


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return str(one.getsockname()[1])


def as_torchrun(rank, port):
    """Variables as torchrun sets them, for a process that a test starts itself."""
    return TORCHRUN | {"RANK": str(rank), "GROUP_RANK": str(rank), "MASTER_PORT": port}


def as_slurm(rank, port):
    """Variables as srun sets them; address and port follow from the name of a node and the job's number."""
    number = {
        "SLURM_PROCID": str(rank),
        "SLURM_NODEID": str(rank),
        "SLURM_JOB_ID": f"7{int(port) % 10000:04d}",
    }
    return SLURM | number | {"SLURM_NODELIST": "localhost"}


def run(command, folder, variables=None):
    """A command in a process to which nobody has told a rank, as other tests of this process may have."""
    return subprocess.Popen(
        [sys.executable, *command],
        cwd=folder,
        env={key: value for key, value in os.environ.items() if key not in TORCHRUN}
        | {"OMP_NUM_THREADS": "1"}
        | (variables or {}),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def start(folder, options, variables=as_torchrun):
    """The same command in two processes, of which each is told that it is alone on its node."""
    port = free_port()
    command = [str(ROOT / "train.py"), *SMALL, "trainer=ddp", *options]
    return [run(command, folder, variables(rank, port)) for rank in (0, 1)]


def start_by_torchrun(folder, options):
    """A torchrun for each node."""
    port, train_py = free_port(), str(ROOT / "train.py")
    where = ["--nnodes=2", "--nproc_per_node=1", "--master_addr=127.0.0.1", f"--master_port={port}"]
    starter = ["-m", "torch.distributed.run", *where]
    options = [*SMALL, "trainer=ddp", *options]
    return [run([*starter, f"--node_rank={rank}", train_py, *options], folder) for rank in (0, 1)]


def ends(processes, seconds=200):
    """What the processes have said, and their exit statuses."""
    texts = [process.communicate(timeout=seconds)[0] for process in processes]
    return texts, [process.returncode for process in processes]


def run_of(folder):
    """The folder of the one run below a folder."""
    [found] = {path.parent for path in (folder / "outputs").rglob(CONFIG) if is_run(path)}
    return found


def is_run(path):
    return not {"first_stage", "evaluations", "latest", ".hydra"} & set(path.parts)


def weights_of(folder):
    return torch.load(run_of(folder) / BEST, weights_only=True)["state_dict"]


def assert_equal(one, other):
    assert all(torch.equal(value, other[name]) for name, value in one.items())


@pytest.fixture(scope="module")
def whole(uneven, tmp_path_factory):  # noqa: F811
    """Options of a training, and the folder of one by two nodes that nobody has stopped."""
    options = ["model=cnn_cls", *uneven, "model.batch_size=2", "model.epochs=3"]
    folder = tmp_path_factory.mktemp("whole")
    texts, statuses = ends(start(folder, options))
    assert statuses == [0, 0], texts
    return options, folder


# --- what is trained -----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "starts"),
    [
        ("cnn_reg", start_by_torchrun),
        ("rcnn_reg", start_by_torchrun),
        ("cnn_reg", lambda *args: start(*args, as_slurm)),
    ],
    ids=["cnn by torchrun", "rcnn by torchrun", "cnn by the variables of Slurm"],
)
def test_two_nodes_score_as_one_process_and_log_once(configure, uneven, tmp_path, model, starts):  # noqa: F811
    options = [f"model={model}", *uneven, *(SMALL_RECURRENT if model == "rcnn_reg" else [])]
    texts, statuses = ends(starts(tmp_path, options))
    assert statuses == [0, 0], texts
    run = run_of(tmp_path)
    assert "epoch" not in texts[1]
    for text in (texts[0], (run / "train.log").read_text()):
        for line in ("epoch  1/2", "epoch  2/2", "encoding 470 scans", "all results are in"):
            assert text.count(line) == 1, line
        assert len(re.findall(r"^epoch  1/", text, re.MULTILINE)) == (2 if model == "rcnn_reg" else 1)
    assert (tmp_path / "outputs" / "latest" / METRICS).resolve() == run / METRICS
    assert len([path for path in (tmp_path / "outputs").rglob(METRICS) if is_run(path)]) == 1
    assert not list((tmp_path / "outputs").rglob(".seen-*"))
    trainer = read_settings(run)["trainer"]
    assert (trainer["devices"], trainer["num_nodes"]) == (1, 2)

    metrics = read_metrics_file(run)
    settings = plain(configure(*options, f"outputs={tmp_path}/outputs"))
    alone = drift_of_one_process(load_module(run / BEST), settings, "val")
    assert metrics["val"]["drift"] == pytest.approx(alone["val/drift"], abs=1e-6)
    again = evaluate(configure(f"run={run}", "trainer=default", name="evaluate", run="evaluations/one"))
    assert again["test"]["drift"] == pytest.approx(metrics["test"]["drift"], abs=1e-6)
    for name, scored in again["test"]["sequences"].items():
        expected = metrics["test"]["sequences"][name]
        assert scored["drift"]["t_err"] == pytest.approx(expected["drift"]["t_err"], abs=1e-6)


@pytest.mark.slow
def test_two_nodes_train_what_two_own_processes_do_and_score_together(configure, whole, tmp_path):
    options, nodes = whole
    own = train(configure(*options, "trainer=ddp", run="own"))
    own_weights = torch.load(tmp_path / "outputs" / "own" / BEST, weights_only=True)["state_dict"]
    assert_equal(weights_of(nodes), own_weights)

    port = free_port()
    command = [str(ROOT / "evaluate.py"), "trainer=ddp", "trainer.accelerator=cpu", "run_dir=evaluations/two"]
    texts, statuses = ends([run(command, nodes, as_torchrun(rank, port)) for rank in (0, 1)])
    assert statuses == [0, 0], texts
    assert texts[1] == ""
    scores = read_metrics_file(nodes / "evaluations" / "two")
    assert scores["test"]["drift"] == pytest.approx(own["test"]["drift"], abs=1e-6)


@pytest.mark.slow
def test_new_worlds_are_made_by_one_process_for_both(tmp_path):
    options = ["model=cnn_reg", "data.frames=20", "data.train=['00','02']", "data.test=['05']", LENGTHS]
    options += ["data.keep_worlds=true"]
    texts, statuses = ends(start(tmp_path, options))
    assert statuses == [0, 0], texts
    assert texts[0].count("new worlds for every epoch") == 1
    assert texts[1] == ""
    names = sorted(path.name.split("-")[0] for path in (tmp_path / "outputs" / "cache").glob("*.npy"))
    assert names == ["00", "00~1", "02", "02~1", "05", "10", "11", "12"]


@pytest.mark.slow
def test_a_job_of_slurm_with_one_task_starts_its_own_processes(uneven, tmp_path):  # noqa: F811
    one_task = as_slurm(0, "1") | {"SLURM_NTASKS": "1", "SLURM_NNODES": "1"}
    command = [str(ROOT / "train.py"), *SMALL, "trainer=ddp", "model=cnn_cls", *uneven, "model.epochs=1"]
    [text], [status] = ends([run(command, tmp_path, one_task)])
    assert status == 0, text
    assert read_settings(run_of(tmp_path))["trainer"]["devices"] == 2
    assert "num_nodes" not in read_settings(run_of(tmp_path))["trainer"]


# --- stopped and killed --------------------------------------------------------------------------


def wait_for_first_epoch(process):
    for line in process.stdout:
        if line.startswith("epoch  1/"):
            time.sleep(0.2)
            return


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_after_a_kill_both_end_and_the_same_command_goes_on_bit_for_bit(whole, tmp_path, killed):
    options, unstopped = whole
    processes = start(tmp_path, options)
    wait_for_first_epoch(processes[0])
    processes[killed].kill()
    texts, statuses = ends(processes, 60)
    assert statuses[killed] == -signal.SIGKILL
    assert statuses[1 - killed] == 1
    assert re.search(r"^error: .*has ended; the same command continues", texts[1 - killed], re.MULTILINE), (
        texts
    )
    assert "Traceback" not in "".join(texts)
    assert (run_of(tmp_path) / LAST).exists()
    texts, statuses = ends(start(tmp_path, options))
    assert statuses == [0, 0], texts
    assert texts[0].count("continuing from") == 1
    assert_equal(weights_of(tmp_path), weights_of(unstopped))


@pytest.mark.slow
def test_asked_to_stop_one_all_save_and_go_on_bit_for_bit(whole, tmp_path):
    options, unstopped = whole
    processes = start(tmp_path, options)
    wait_for_first_epoch(processes[0])
    processes[1].terminate()
    texts, statuses = ends(processes, 60)
    assert statuses == [130, 130], texts
    assert "the same command continues" in texts[0]
    step = torch.load(run_of(tmp_path) / LAST, weights_only=True)["global_step"]
    texts, statuses = ends(start(tmp_path, options))
    assert statuses == [0, 0], texts
    assert f"step {step}\n" in texts[0]
    assert_equal(weights_of(tmp_path), weights_of(unstopped))


# --- mistakes ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["trainer.devices=2"],
            r"trainer.devices=2 trainer.num_nodes=2: torchrun has started 2",
        ),
        (["model.batch_size=7"], r"model.batch_size=7: windows cannot be shared evenly among 2 devices"),
        (
            ["model=rcnn_reg", *SMALL_RECURRENT, "data.train=['03']", "model.window=44"],
            r"have 1 windows of 44 pairs, fewer than the 2 devices",
        ),
        (["model.learning_rate=1e30", "trainer.gradient_clip_val=null"], "training diverged in epoch 1"),
    ],
)
def test_a_mistake_is_one_line_of_the_first_process(uneven, tmp_path, options, message):  # noqa: F811
    texts, statuses = ends(start(tmp_path, ["model=cnn_reg", *uneven, *options]), 60)
    assert statuses == [1, 1], texts
    assert texts[1] == ""
    assert "Traceback" not in texts[0]
    errors = [line for line in texts[0].splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, texts
    assert re.search(message, errors[0])


@pytest.mark.slow
def test_a_mistake_of_another_process_is_told_by_the_first(uneven, tmp_path):  # noqa: F811
    """A recording that only the first node has."""
    port, elsewhere = free_port(), tmp_path / "elsewhere"
    elsewhere.mkdir()
    options = [*SMALL, "trainer=ddp", "model=cnn_reg", *uneven, f"outputs={tmp_path}/outputs"]
    command = [str(ROOT / "train.py"), *options]
    (tmp_path / "kitti").symlink_to(uneven[0].split("=")[1])
    command = [*command, "data.root=kitti"]
    folders = (tmp_path, elsewhere)
    texts, statuses = ends([run(command, folders[rank], as_torchrun(rank, port)) for rank in (0, 1)], 60)
    assert statuses == [1, 1], texts
    assert texts[1] == ""
    assert re.search(r"^error: process 1 of 2 on .*kitti", texts[0], re.MULTILINE), texts


@pytest.mark.parametrize("rank", [0, 1])
def test_a_sweep_is_refused(tmp_path, rank):
    command = [str(ROOT / "train.py"), "-m", "model=cnn_reg,cnn_cls", "trainer=ddp"]
    [text], [status] = ends([run(command, tmp_path, as_torchrun(rank, "1"))], 60)
    assert status == 1
    told = "error: -m: torchrun has started 2 processes for a single run; start the sweep by python"
    assert text.startswith(told) if rank == 0 else text == ""
    assert text.count("\n") == 1 - rank


def test_a_rank_without_the_rest_is_refused(tmp_path):
    [text], [status] = ends([run([str(ROOT / "train.py")], tmp_path, {"RANK": "1", "WORLD_SIZE": "2"})], 60)
    assert status == 1
    assert text == (
        "error: RANK is set, but not LOCAL_RANK, LOCAL_WORLD_SIZE, MASTER_ADDR, MASTER_PORT; "
        "start the command by torchrun, or unset it\n"
    )


# --- who has started what ------------------------------------------------------------------------


def without(variables, name):
    return {key: value for key, value in variables.items() if key != name}


@pytest.mark.parametrize(
    ("variables", "world"),
    [
        ({}, None),
        ({"MASTER_ADDR": "here", "MASTER_PORT": "1"}, None),
        (TORCHRUN, World("torchrun", 1, 2, 1)),
        (SLURM, World("srun", 1, 2, 1)),
        (SLURM | TORCHRUN, World("torchrun", 1, 2, 1)),  # srun has started torchrun
        (SLURM | {"SLURM_NTASKS": "1", "SLURM_PROCID": "0"}, None),
        (without(SLURM, "SLURM_STEP_ID"), None),  # a batch script itself
        (SLURM | {"SLURM_NTASKS": "8", "SLURM_NTASKS_PER_NODE": "4"}, World("srun", 1, 8, 4)),
    ],
)
def test_the_world_is_as_its_variables_say(variables, world):
    assert find_world(variables) == world


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        *((without(TORCHRUN, name), f"set, but not {name}; .* by torchrun") for name in TORCHRUN),
        (
            without(SLURM, "SLURM_PROCID"),
            "SLURM_NTASKS is set, but not SLURM_PROCID; .* by srun",
        ),
        (
            without(SLURM, "SLURM_NTASKS_PER_NODE"),
            "not SLURM_NTASKS_PER_NODE; .* srun --ntasks-per-node=N",
        ),
        (TORCHRUN | {"RANK": "2"}, "RANK=2 WORLD_SIZE=2 .*: these contradict each other"),
        (TORCHRUN | {"WORLD_SIZE": "two"}, "WORLD_SIZE=two .*: these contradict each other"),
        (TORCHRUN | {"WORLD_SIZE": "3", "LOCAL_WORLD_SIZE": "2"}, "must start as many on every node"),
    ],
)
def test_variables_that_do_not_fit_are_refused(variables, message):
    with pytest.raises(InputError, match=message):
        find_world(variables)


def test_devices_and_nodes_are_those_that_were_started(monkeypatch):
    trainer = {"devices": 2, "num_nodes": 1, "strategy": "ddp_spawn"}
    check_devices(trainer)
    assert trainer == {"devices": 2, "strategy": "ddp_spawn"}
    assert processes_per_node(2) == 2
    for name, value in (SLURM | {"SLURM_NTASKS": "8", "SLURM_NTASKS_PER_NODE": "4"}).items():
        monkeypatch.setenv(name, value)
    assert processes_per_node(2) == 4
    for devices in (4, [0, 1, 2, 3]):
        trainer = {"devices": devices, "strategy": "ddp_spawn"}
        check_devices(trainer)
        assert trainer["num_nodes"] == 2
    with pytest.raises(InputError, match=r"srun has started 8 processes, 4 on each node; set"):
        check_devices({"devices": 8, "strategy": "ddp_spawn"})
    with pytest.raises(InputError, match=r"devices=4 trainer.num_nodes=3: srun has started 8 processes"):
        check_devices({"devices": 4, "num_nodes": 3, "strategy": "ddp_spawn"})
    with pytest.raises(
        InputError, match=r"trainer.strategy=auto: srun has started 8 processes; set trainer=ddp"
    ):
        check_devices({"devices": 4})


def test_a_folder_that_another_node_does_not_see_is_told(monkeypatch, tmp_path):
    monkeypatch.setattr(cluster, "FILE_TIMEOUT", 0.0)
    work = cluster.Work(lambda: None, "fit", None, None, {}, {}, [tmp_path / ".seen-1"])
    with pytest.raises(InputError, match="is not the first process' folder; start all processes in the same"):
        cluster._prepare(work)
