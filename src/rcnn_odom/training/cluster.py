"""One command in processes that torchrun or Slurm has started, perhaps on several machines.

The first process runs the command. The others only take part when it trains or tests, and wait in between. So
whatever must happen once (the run's folder, logs, encoding, locks, scores) happens once, and two processes
cannot wait for each other's lock.
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

if TYPE_CHECKING:  # both with torch, which would make --help slow
    import lightning as L
    from lightning.fabric.plugins.environments import ClusterEnvironment

    from rcnn_odom.training.datamodule import OdometryDataModule

PATIENCE = timedelta(days=1)
"""How long processes wait for each other: the first one encodes, or waits for another training, alone."""
POLLING = 0.1
"""Seconds between looks for the next piece of work; signals are noticed in between."""
FAREWELL = 5.0
"""Seconds that the last word of a process has to reach the others."""
SEEN_WITHIN = 30.0
"""Seconds after which a new file is seen on every node; NFS may keep an older listing of a folder so long."""

TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
"""Variables of which each says that torchrun has started this process."""
ADDRESS = ("MASTER_ADDR", "MASTER_PORT")
SLURM = ("SLURM_PROCID", "SLURM_NTASKS", "SLURM_LOCALID", "SLURM_NTASKS_PER_NODE")
"""Variables of a task that srun has started: the same numbers as those of torchrun."""
BY_THE_SAME = "the same command goes on from the last checkpoint"


class World(NamedTuple):
    """The processes that something else has started for one command.

    Attributes:
        starter: who has, in words.
        rank: number of this process, from 0.
        size: how many processes there are.
        per_node: how many of them on each node.
    """

    starter: str
    rank: int
    size: int
    per_node: int

    @property
    def nodes(self) -> int:
        """How many machines there are."""
        return self.size // self.per_node


def find_world(variables: Mapping[str, str] = os.environ) -> World | None:
    """What torchrun or Slurm says about this process; None: nobody but this command starts processes.

    A job of Slurm with one task starts its own processes, as does a command that was not started by ``srun``.

    Raises:
        InputError: variables are missing, or make no sense together.
    """
    if any(name in variables for name in TORCHRUN):
        return _read_world("torchrun", variables, TORCHRUN, ADDRESS)
    # A batch script has SLURM_NTASKS too, but is not one of the tasks.
    if variables.get("SLURM_NTASKS", "1") != "1" and "SLURM_STEP_ID" in variables:
        return _read_world("srun", variables, SLURM, ())
    return None


def _read_world(
    starter: str, variables: Mapping[str, str], names: tuple[str, ...], others: tuple[str, ...]
) -> World:
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
        told = " ".join(f"{name}={variables[name]}" for name in names)
        raise InputError(f"{told}: these do not fit together; {starter} must start as many on every node")
    return World(starter, rank, size, per_node)


def refuse_sweep(world: World | None) -> None:
    """For a sweep, whose jobs the processes could not agree on.

    Raises:
        InputError: there are several processes.
    """
    if world and world.size > 1:
        raise InputError(
            f"-m: {world.starter} has started {world.size} processes, which train one run; start the sweep "
            "by python, or train its runs one by one"
        )


def environment_of(world: World) -> "ClusterEnvironment":
    """What Lightning asks about the processes.

    Raises:
        InputError: it does not accept what Slurm says.
    """
    from lightning.pytorch.plugins.environments import SLURMEnvironment, TorchElasticEnvironment

    if world.starter == "torchrun":
        return TorchElasticEnvironment()
    try:
        # A run saves and goes on by itself; Lightning would write checkpoints of its own.
        return SLURMEnvironment(auto_requeue=False)
    except RuntimeError as error:
        raise InputError(" ".join(str(error).split())) from error


@dataclass
class Work:
    """What the first process lets all of them do.

    Attributes:
        build: picklable; makes the Trainer of a process.
        name: of what the Trainer does, ``fit`` or ``test``.
        module, datamodule, options: arguments of that.
        keys: of the drives by split, to compare.
        marks: files that every process must see.
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
    world: World
    store: Any  # torch's Store: a dictionary that all processes see
    works: int = 0


_team: _Team | None = None
"""Of this process, once it has met the others."""


def has_joined() -> bool:
    """Whether this process works together with others that it has not started."""
    return _team is not None


def run_in(world: World, command: Callable[[], int]) -> int:
    """Runs a command in the first process of several, and follows it in the others; the exit status.

    Raises:
        InputError: the processes do not find each other.
    """
    global _team
    _team = _meet(world)
    try:
        return _lead(_team, command) if world.rank == 0 else _follow(_team)
    finally:
        _team = None


def _meet(world: World) -> _Team:
    import torch.distributed as dist

    environment = environment_of(world)
    os.environ["MASTER_ADDR"] = environment.main_address
    os.environ["MASTER_PORT"] = str(environment.main_port)
    try:
        store, rank, size = next(iter(dist.rendezvous("env://", world.rank, world.size, timeout=PATIENCE)))
        # No backend is named: gloo for what is said, NCCL for what GPUs compute. Lightning takes it as it is.
        dist.init_process_group(store=store, rank=rank, world_size=size, timeout=PATIENCE)
        # The store may be torchrun's, which can hold what other processes have left.
        name = [uuid.uuid4().hex]
        dist.broadcast_object_list(name, 0)
    except (RuntimeError, ValueError) as error:
        place = f"{os.environ['MASTER_ADDR']}:{os.environ['MASTER_PORT']}"
        reason = str(error).splitlines()[0]
        raise InputError(f"{place}: the processes do not find each other there ({reason})") from error
    return _Team(world, dist.PrefixStore(name[0], store))


def _lead(team: _Team, command: Callable[[], int]) -> int:
    """The first process: its command; the others end with the same status."""
    status = 1
    try:
        status = command()
    finally:
        _leave()
        with suppress(RuntimeError):  # the one who keeps the store may be gone
            team.store.set("end", str(status))
            # They may need this process to read it.
            _wait_until(lambda: team.store.add("gone", 0) == team.world.size - 1, FAREWELL)
    return status


def _leave() -> None:
    """Hangs up, so that nobody waits for this process any longer."""
    import torch.distributed as dist

    with suppress(RuntimeError, ValueError, AssertionError):
        dist.destroy_process_group()


def _wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not (met := condition()) and time.monotonic() < end:
        time.sleep(POLLING)
    return met


def _follow(team: _Team) -> int:
    """Every other process: works until the first one ends; the exit status."""
    try:
        while (end := _wait_for_work(team)) is None:
            _do(team)
        return end
    except (KeyboardInterrupt, SystemExit):  # the latter is how Lightning ends after Ctrl-C
        raise KeyboardInterrupt from None
    except Exception as error:
        return _end_by(team, error)
    finally:
        _leave()
        with suppress(RuntimeError):
            team.store.add("gone", 1)


def _wait_for_work(team: _Team) -> int | None:
    """None once there is some, or the exit status if there will be none."""
    team.works += 1
    while not team.store.check([f"work {team.works}"]):
        if team.store.check(["end"]):
            return int(team.store.get("end"))
        time.sleep(POLLING)
    return None


def _end_by(team: _Team, error: Exception) -> int:
    """After an error: the first process tells it, if it is there and has none of its own."""
    _leave()
    is_users = isinstance(error, InputError | OSError)
    with suppress(RuntimeError):
        if is_users:
            team.store.set("failed", f"{_name(team.world)}: {error}")
        if (is_users or is_lost(error)) and _wait_until(lambda: team.store.check(["end"]), FAREWELL):
            return int(team.store.get("end")) or 1
    if is_users:
        raise error
    if is_lost(error):
        raise InputError(f"the first process has ended; {BY_THE_SAME}") from error
    raise error


def _name(world: World) -> str:
    return f"process {world.rank} of {world.size} on {socket.gethostname()}"


def is_lost(error: Exception) -> bool:
    """Whether an error means that another process is not there any longer."""
    import torch.distributed as dist

    return isinstance(error, dist.DistError) or (isinstance(error, RuntimeError) and "gloo" in str(error))


def lost(error: Exception) -> Exception:
    """What the first process raises instead of such an error: what the other one said, if it did."""
    if _team is None or not is_lost(error):
        return error
    with suppress(RuntimeError):
        if _wait_until(lambda: _team.store.check(["failed"]), FAREWELL):  # type: ignore[union-attr]
            return InputError(_team.store.get("failed").decode())
    return InputError(f"another process of this training has ended; {BY_THE_SAME}")


def share(
    build: "Callable[[], L.Trainer]",
    name: str,
    module: "L.LightningModule",
    datamodule: "OdometryDataModule",
    folders: list[Path],
    **options: Any,
) -> None:
    """Lets the other processes do what this one does next; nothing where there are none.

    Args:
        build: picklable; makes a Trainer like this process' own.
        name: ``fit`` or ``test``.
        module, datamodule, options: arguments of that.
        folders: of files that all processes need.

    Raises:
        InputError: one of them cannot.
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
        if reasons := _gather(_team.world, ""):
            raise InputError(reasons[0])


def _without_trainer(datamodule: "OdometryDataModule") -> "OdometryDataModule":
    """A copy for another process, without drives and the Trainer of this one."""
    copy = datamodule.__class__.__new__(datamodule.__class__)
    copy.__dict__ |= datamodule.__getstate__() | {"trainer": None}
    return copy


@contextmanager
def _marks(folders: list[Path]) -> Iterator[list[Path]]:
    """Files that nobody else can have made, one in each folder, for as long as the others look for them."""
    marks = [folder / f".seen-{uuid.uuid4().hex}" for folder in folders]
    try:
        for mark in marks:
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.touch()
        yield marks
    finally:
        for mark in marks:
            mark.unlink(missing_ok=True)


def _gather(world: World, reason: str) -> list[str]:
    """Reasons of all processes why they cannot work; an empty one is none."""
    import torch.distributed as dist

    reasons: list[Any] = [None] * world.size
    dist.all_gather_object(reasons, reason)
    return [each for each in reasons if each]


def _do(team: _Team) -> None:
    """What the first process does next; it ends in all of them, or in none."""
    import torch.distributed as dist

    from rcnn_odom.training.saving import Stopped, TimeUp

    received: list[Any] = [None]
    dist.broadcast_object_list(received, 0)
    work: Work = received[0]
    reason, trainer = "", None
    try:
        trainer = _prepare(work)
    except (InputError, OSError) as error:
        reason = f"{_name(team.world)}: {error}"
    if _gather(team.world, reason):
        return
    with suppress(Stopped, TimeUp):  # agreed on by all
        getattr(trainer, work.name)(work.module, datamodule=work.datamodule, **work.options)


def _prepare(work: Work) -> "L.Trainer":
    """The Trainer of this process, its data loaded.

    Raises:
        InputError: the files are not those of the first process, or a device is missing.
    """
    import lightning as L

    for mark in work.marks:
        if not _wait_until(mark.exists, SEEN_WITHIN):
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
