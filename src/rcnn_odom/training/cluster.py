"""Runs one command in processes that torchrun or Slurm has started, possibly on several machines.

The first process runs the command. The others only take part in training and testing, and wait otherwise. So
everything that must happen once (the run's folder, logs, encoding, locks, scores) happens once, and processes
cannot wait for each other's locks.
"""

import os
import socket
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rcnn_odom.errors import InputError

if TYPE_CHECKING:  # Both import torch, which would make --help slow.
    import lightning as L
    from lightning.fabric.plugins.environments import ClusterEnvironment

    from rcnn_odom.training.datamodule import OdometryDataModule

CONNECTION_TIMEOUT = timedelta(days=1)
"""Longest time that processes wait, while the first one encodes or waits for another training."""
POLLING = 0.1
"""Seconds between checks for new work; signals are handled in between."""
MESSAGE_TIMEOUT = 5.0
"""Seconds for the last message of a process to reach the others."""
FILE_TIMEOUT = 30.0
"""Seconds until a new file is visible on every node; NFS can cache the listing of a folder so long."""

TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
"""Environment variables that torchrun sets; any of them shows that it has started this process."""
ADDRESS = ("MASTER_ADDR", "MASTER_PORT")
SLURM = ("SLURM_PROCID", "SLURM_NTASKS", "SLURM_LOCALID", "SLURM_NTASKS_PER_NODE")
"""Environment variables of a task of srun, with the same meaning as those of torchrun."""
CONTINUE_ADVICE = "the same command continues from the last checkpoint"


class World(NamedTuple):
    """The processes that torchrun or Slurm has started for one command.

    Attributes:
        starter: ``torchrun`` or ``srun``.
        rank: number of this process, from 0.
        size: number of processes.
        per_node: number of processes on each node.
    """

    starter: str
    rank: int
    size: int
    per_node: int

    @property
    def nodes(self) -> int:
        """Number of machines."""
        return self.size // self.per_node


def find_world(variables: Mapping[str, str] = os.environ) -> World | None:
    """Reads from environment variables which processes torchrun or Slurm has started.

    Returns:
        None if the command starts its own processes. This includes a Slurm job with one task, and a command
        in a Slurm job that was not started by ``srun``.

    Raises:
        InputError: variables are missing or contradict each other.

    >>> find_world({"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "1",
    ...             "MASTER_ADDR": "localhost", "MASTER_PORT": "29500"})
    World(starter='torchrun', rank=1, size=2, per_node=1)
    >>> find_world({}) is None
    True
    """
    if any(name in variables for name in TORCHRUN):
        return _read_world("torchrun", variables, TORCHRUN, ADDRESS)
    # A batch script also has SLURM_NTASKS, but is not a task.
    if variables.get("SLURM_NTASKS", "1") != "1" and "SLURM_STEP_ID" in variables:
        return _read_world("srun", variables, SLURM, ())
    return None


def _read_world(
    starter: str, variables: Mapping[str, str], names: tuple[str, ...], others: tuple[str, ...]
) -> World:
    """Reads the rank, size, local rank and local size from variables.

    Args:
        starter: ``torchrun`` or ``srun``.
        variables: the environment variables.
        names: names of the variables with these four numbers.
        others: names of further required variables.
    """
    wanted = (*names, *others)
    missing = [name for name in wanted if not variables.get(name)]
    if missing:
        present = next(name for name in names if name in variables)
        how = "srun --ntasks-per-node=N" if starter == "srun" else "torchrun, or unset it"
        raise InputError(f"{present} is set, but not {', '.join(missing)}; start the command by {how}")
    try:
        rank, size, local_rank, per_node = (int(variables[name]) for name in names)
    except ValueError:
        rank, size, local_rank, per_node = -1, 0, 0, 1
    if not (0 <= rank < size and 0 <= local_rank < per_node and size % per_node == 0):
        values = " ".join(f"{name}={variables[name]}" for name in names)
        raise InputError(f"{values}: these contradict each other; {starter} must start as many on every node")
    return World(starter, rank, size, per_node)


def refuse_sweep(world: World | None) -> None:
    """Refuses a sweep in several processes, which could not agree on its jobs.

    Raises:
        InputError: there are several processes.
    """
    if world and world.size > 1:
        raise InputError(
            f"-m: {world.starter} has started {world.size} processes for a single run; start the sweep by "
            "python, or train its runs one by one"
        )


def environment_of(world: World) -> "ClusterEnvironment":
    """Lightning's cluster environment for these processes.

    Raises:
        InputError: Lightning does not accept the variables of Slurm.
    """
    from lightning.pytorch.plugins.environments import SLURMEnvironment, TorchElasticEnvironment

    if world.starter == "torchrun":
        return TorchElasticEnvironment()
    try:
        # Runs save and resume without Lightning, which would write further checkpoints.
        return SLURMEnvironment(auto_requeue=False)
    except RuntimeError as error:
        raise InputError(" ".join(str(error).split())) from error


@dataclass
class Work:
    """A training or test that the first process asks all processes to do.

    Attributes:
        build: picklable function that builds the Trainer of a process.
        name: method of the Trainer, ``fit`` or ``test``.
        module, datamodule, options: arguments of that method.
        keys: keys of the drives by split, for a comparison.
        marks: files that must be visible to every process.
    """

    build: "Callable[[], L.Trainer]"
    name: str
    module: "L.LightningModule"
    datamodule: "OdometryDataModule"
    options: dict[str, Any]
    keys: dict[str, list[str]]
    marks: list[Path]


@dataclass
class _Team:
    """The connected processes.

    Attributes:
        world: the processes.
        store: torch's Store, a dictionary that all processes share.
        works: number of trainings and tests so far.
    """

    world: World
    store: Any
    works: int = 0


_team: _Team | None = None
"""The processes that this one is connected to; None before."""


def has_joined() -> bool:
    """Whether this process is connected to others that torchrun or Slurm has started."""
    return _team is not None


def run_in(world: World, command: Callable[[], int]) -> int:
    """Runs a command in the first process; the others take part in its trainings and tests.

    Returns:
        The exit status.

    Raises:
        InputError: the processes cannot connect to each other.
    """
    global _team
    _team = _connect(world)
    try:
        return _run_in_first(_team, command) if world.rank == 0 else _work_for_first(_team)
    finally:
        _team = None


def _connect(world: World) -> _Team:
    """Connects the processes to each other."""
    import torch.distributed as dist

    environment = environment_of(world)
    os.environ["MASTER_ADDR"] = environment.main_address
    os.environ["MASTER_PORT"] = str(environment.main_port)
    try:
        store, rank, size = next(
            iter(dist.rendezvous("env://", world.rank, world.size, timeout=CONNECTION_TIMEOUT))
        )
        # Without a backend, torch uses gloo for messages and NCCL for GPUs. Lightning uses the same group.
        dist.init_process_group(store=store, rank=rank, world_size=size, timeout=CONNECTION_TIMEOUT)
        # The store may belong to torchrun and have entries of earlier processes, so the prefix is unique.
        name = [uuid.uuid4().hex]
        dist.broadcast_object_list(name, 0)
    except (RuntimeError, ValueError) as error:
        place = f"{os.environ['MASTER_ADDR']}:{os.environ['MASTER_PORT']}"
        reason = str(error).splitlines()[0]
        raise InputError(f"{place}: the processes cannot connect to each other there ({reason})") from error
    return _Team(world, dist.PrefixStore(name[0], store))


def _run_in_first(team: _Team, command: Callable[[], int]) -> int:
    """Runs the command in the first process, and makes the others end with the same exit status."""
    status = 1
    try:
        status = command()
    finally:
        _disconnect()
        with suppress(RuntimeError):  # The process with the store may have ended.
            team.store.set("end", str(status))
            # This process may have the store that the others read.
            _wait_until(lambda: team.store.add("gone", 0) == team.world.size - 1, MESSAGE_TIMEOUT)
    return status


def _disconnect() -> None:
    """Closes the connection, so that no process waits for this one."""
    import torch.distributed as dist

    with suppress(RuntimeError, ValueError, AssertionError):
        dist.destroy_process_group()


def _wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    """Waits until a condition is met; returns False if it is not met in time."""
    end = time.monotonic() + seconds
    while not (met := condition()) and time.monotonic() < end:
        time.sleep(POLLING)
    return met


def _work_for_first(team: _Team) -> int:
    """Works in every other process until the first one ends; returns the exit status."""
    try:
        while (end := _wait_for_work(team)) is None:
            _do_work(team)
        return end
    except (KeyboardInterrupt, SystemExit):  # Lightning raises SystemExit after Ctrl-C.
        raise KeyboardInterrupt from None
    except Exception as error:
        return _end_after_error(team, error)
    finally:
        _disconnect()
        with suppress(RuntimeError):
            team.store.add("gone", 1)


def _wait_for_work(team: _Team) -> int | None:
    """Waits for work; returns None if there is some, or the exit status if the command has ended."""
    team.works += 1
    while not team.store.check([f"work {team.works}"]):
        if team.store.check(["end"]):
            return int(team.store.get("end"))
        time.sleep(POLLING)
    return None


def _end_after_error(team: _Team, error: Exception) -> int:
    """Sends an error to the first process, which reports it; returns the exit status.

    Raises:
        InputError: the first process does not answer.
    """
    _disconnect()
    is_users = isinstance(error, InputError | OSError)
    with suppress(RuntimeError):
        if is_users:
            team.store.set("failed", f"{_describe_process(team.world)}: {error}")
        if (is_users or _is_lost_process(error)) and _wait_until(
            lambda: team.store.check(["end"]), MESSAGE_TIMEOUT
        ):
            return int(team.store.get("end")) or 1
    if is_users:
        raise error
    if _is_lost_process(error):
        raise InputError(f"the first process has ended; {CONTINUE_ADVICE}") from error
    raise error


def _describe_process(world: World) -> str:
    """Rank and machine of this process, for a message."""
    return f"process {world.rank} of {world.size} on {socket.gethostname()}"


def _is_lost_process(error: Exception) -> bool:
    """Whether an error means that another process has ended."""
    import torch.distributed as dist

    return isinstance(error, dist.DistError) or (isinstance(error, RuntimeError) and "gloo" in str(error))


def translate_lost_process(error: Exception) -> Exception:
    """Replaces an error that another process has caused by that process's own message, if it sent one."""
    if _team is None or not _is_lost_process(error):
        return error
    with suppress(RuntimeError):
        if _wait_until(lambda: _team.store.check(["failed"]), MESSAGE_TIMEOUT):  # type: ignore[union-attr]
            return InputError(_team.store.get("failed").decode())
    return InputError(f"another process of this training has ended; {CONTINUE_ADVICE}")


def start_in_others(
    build: "Callable[[], L.Trainer]",
    name: str,
    module: "L.LightningModule",
    datamodule: "OdometryDataModule",
    folders: list[Path],
    **options: Any,
) -> None:
    """Starts the same training or test in the other processes, if there are any.

    Args:
        build: picklable function that builds the same Trainer as that of this process.
        name: method of the Trainer, ``fit`` or ``test``.
        module, datamodule, options: arguments of that method.
        folders: folders that all processes must have in common.

    Raises:
        InputError: one of the processes cannot take part.
    """
    if _team is None:
        return
    import torch.distributed as dist

    keys = {split: [drive.key for drive in drives] for split, drives in datamodule.drives.items()}
    with _marks(folders) as marks:
        work = Work(build, name, module, _without_trainer(datamodule), options, keys, marks)
        _team.works += 1
        _team.store.set(f"work {_team.works}", "")
        dist.broadcast_object_list([work], 0)
        if reasons := _gather_reasons(_team.world, ""):
            raise InputError(reasons[0])


def _without_trainer(datamodule: "OdometryDataModule") -> "OdometryDataModule":
    """A copy for another process, without drives and without the Trainer."""
    copy = datamodule.__class__.__new__(datamodule.__class__)
    copy.__dict__ |= datamodule.__getstate__() | {"trainer": None}
    return copy


@contextmanager
def _marks(folders: list[Path]) -> Iterator[list[Path]]:
    """Creates a file with a unique name in each folder while the other processes look for it."""
    marks = [folder / f".seen-{uuid.uuid4().hex}" for folder in folders]
    try:
        for mark in marks:
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.touch()
        yield marks
    finally:
        for mark in marks:
            mark.unlink(missing_ok=True)


def _gather_reasons(world: World, reason: str) -> list[str]:
    """Collects from all processes the reason why one cannot take part; an empty reason means that it can."""
    import torch.distributed as dist

    reasons: list[Any] = [None] * world.size
    dist.all_gather_object(reasons, reason)
    return [each for each in reasons if each]


def _do_work(team: _Team) -> None:
    """Receives a training or test and runs it, unless one of the processes cannot take part."""
    import torch.distributed as dist

    from rcnn_odom.training.saving import Stopped, TimeUp

    received: list[Any] = [None]
    dist.broadcast_object_list(received, 0)
    work: Work = received[0]
    reason, trainer = "", None
    try:
        trainer = _prepare(work)
    except (InputError, OSError) as error:
        reason = f"{_describe_process(team.world)}: {error}"
    if _gather_reasons(team.world, reason):
        return
    with suppress(Stopped, TimeUp):  # All processes stop together.
        getattr(trainer, work.name)(work.module, datamodule=work.datamodule, **work.options)


def _prepare(work: Work) -> "L.Trainer":
    """Builds the Trainer of this process and loads its data.

    Raises:
        InputError: the folders or recordings differ from those of the first process, or a device is missing.
    """
    import lightning as L

    for mark in work.marks:
        if not _wait_until(mark.exists, FILE_TIMEOUT):
            raise InputError(
                f"{mark.parent}: is not the first process' folder; start all processes in the same folder, "
                "with outputs and run_dir on a file system that all nodes share"
            )
    L.seed_everything(work.datamodule.seed, verbose=False)
    trainer = work.build()
    data = work.datamodule.load(tuple(work.keys))
    if {split: [drive.key for drive in drives] for split, drives in data.drives.items()} != work.keys:
        raise InputError("the recordings differ from those of the first process; copy the same to all nodes")
    return trainer
