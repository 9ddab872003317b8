"""Finds and opens the files of a ROS bag, and reads the messages of a topic from them."""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.bags.chunks import BrokenBag, ChunkedFile, NoBag
from rcnn_odom.recordings.bags.mcap import MAGIC, McapFile
from rcnn_odom.recordings.bags.ros1 import Ros1File
from rcnn_odom.recordings.bags.sqlite import SqliteFile
from rcnn_odom.recordings.packing import read_head, unpacked_file

METADATA = "metadata.yaml"
"""A file in the folder of a ROS 2 bag."""
STORAGE_SUFFIXES = (".db3", ".mcap")
"""Suffixes of the files with messages in such a folder."""
SUFFIXES = (".bag", *STORAGE_SUFFIXES)
FURTHER_SUFFIXES = (".active", ".gz", ".bz2", ".xz", ".zst", ".zstd")
"""Suffixes that may follow ``SUFFIXES``."""
ROS1 = b"#ROSBAG V2"
OLD_ROS1 = (b"#ROSBAG V1", b"#ROSRECORD V1")
BagFile: TypeAlias = ChunkedFile | SqliteFile
KINDS: dict[bytes, Callable[[Path], BagFile]] = {
    ROS1: Ros1File,
    MAGIC: McapFile,
    b"SQLite format 3\0": SqliteFile,
}
"""First bytes of the files of bags, and the classes that read them."""
REPAIR_ADVICE = (
    "a bag whose recording was cut off can be repaired by 'rosbag reindex' or 'ros2 bag reindex', "
    "mcap by 'mcap recover'"
)


class RawMessage(NamedTuple):
    """A message before it is decoded.

    Attributes:
        encoding: ``ros1``, ``cdr`` or another one.
        arrival: time of arrival in nanoseconds.
        content: bytes of the message.
    """

    encoding: str
    arrival: int
    content: memoryview


class Bag:
    """A bag: its files are read one after another.

    Args:
        files: name and file, in order.
        unpacked: closes and removes the temporary files.
        faults: messages about files that cannot be opened.
        notes: messages for the user.

    Attributes:
        topics: for the name of each topic, the number of messages of each type.
        broken: faults of the files that are cut off or cannot be opened; empty if there are none.
    """

    def __init__(
        self,
        files: list[tuple[str, BagFile]],
        unpacked: ExitStack,
        faults: tuple[str, ...] = (),
        notes: tuple[str, ...] = (),
    ) -> None:
        self._files, self._unpacked, self._faults, self.notes = files, unpacked, faults, notes
        self.topics: dict[str, Counter[str]] = defaultdict(Counter)
        for _, file in files:
            for number, connection in file.connections.items():
                self.topics[connection.topic][connection.kind] += file.counts[number]
        broken = (self._name_fault(name, file.broken) for name, file in files if file.broken)
        self.broken = ", ".join((*broken, *faults))

    def encodings(self, topic: str, kind: str) -> set[str]:
        """The encodings of a topic's messages of a type."""
        connections = [c for _, file in self._files for c in file.connections.values()]
        return {c.encoding for c in connections if (c.topic, c.kind) == (topic, kind)}

    def messages(self, topic: str, kind: str) -> Iterator[RawMessage]:
        """Yield the messages of a topic of one type, file by file, in each file in the order of arrival.

        Raises:
            BrokenBag: a file is damaged or cannot be opened; raised after the last message of all files that
                can be read.
        """
        faults = list(self._faults)
        for name, file in self._files:
            wanted = {n for n, c in file.connections.items() if (c.topic, c.kind) == (topic, kind)}
            try:
                for arrival, number, content in file.messages(wanted):
                    yield RawMessage(file.connections[number].encoding, arrival, content)
            except BrokenBag as error:
                faults.append(self._name_fault(name, str(error)))
        if faults:
            raise BrokenBag(", ".join(faults))

    def _name_fault(self, name: str, fault: str) -> str:
        is_one_of_several = len(self._files) + len(self._faults) > 1
        return f"{name}: {fault}" if is_one_of_several else fault

    def close(self) -> None:
        """Remove the temporary files."""
        self._unpacked.close()


def is_bag(path: Path) -> bool:
    """Whether the path is a bag's file or folder, by its first bytes or by its name."""
    if path.is_dir():
        return (path / METADATA).is_file() or bool(_storage_files(path))
    if not path.is_file():
        return False
    if path.name == METADATA or _is_named_like_bag(path):
        return True
    try:
        return read_head(path).startswith((*KINDS, *OLD_ROS1))
    except InputError:
        return False


def open_bag(path: Path) -> Bag:
    """Open the files of a bag; if there are several, those that can be opened.

    Args:
        path: a file, compressed or not; the folder of a ROS 2 bag; or the metadata.yaml in it.

    Raises:
        InputError: a file is missing, or no file can be opened as a bag.
    """
    paths, notes = files_of(path)
    files: list[tuple[str, BagFile]] = []
    errors: dict[Path, InputError] = {}
    with ExitStack() as stack:
        for each in paths:
            try:
                files.append((each.name, _open_file(each, stack)))
            except InputError as error:  # a recorder that crashed leaves its last file empty
                errors[each] = error
        if not files:
            raise errors[paths[0]]
        faults = tuple(f"{each.name}: {_shorten_error(each, error)}" for each, error in errors.items())
        left_out = tuple(f"left out: {fault}" for fault in faults)
        return Bag(files, stack.pop_all(), faults, (*notes, *left_out))


def _shorten_error(path: Path, error: InputError) -> str:
    """The message of an error without the file's path and without the advice."""
    return str(error).removeprefix(f"{path}: ").partition("; ")[0]


def files_of(path: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Find the files of a bag.

    The files of a folder are those named in its metadata.yaml. If that is missing or cannot be read, they are
    all .db3 and .mcap files in the folder, in the order of the numbers in their names.

    Returns:
        The files in order, and a note if there are several or metadata.yaml could not be used.

    Raises:
        InputError: metadata.yaml names a file that is missing, or there is no file.
    """
    if path.name == METADATA and path.is_file():
        path = path.absolute().parent
    if path.is_file():
        return [path], ()
    metadata = path / METADATA
    named = _named_files(metadata)
    found = [_find_named_file(path, name) for name in named] or _storage_files(path)
    if not found:
        raise InputError(f"{path}: no .db3 or .mcap file beside {METADATA}; copy the files of the bag too")
    listed = ", ".join(file.name for file in found)
    if metadata.exists() and not named:
        return found, (f"{METADATA} names no files that can be read; files in the folder are read: {listed}",)
    return found, (f"{len(found)} files: {listed}",) if len(found) > 1 else ()


def _is_named_like_bag(path: Path) -> bool:
    name = path.name.lower()
    while name.endswith(FURTHER_SUFFIXES):
        name = name.rpartition(".")[0]
    return name.endswith(SUFFIXES)


def _storage_files(folder: Path) -> list[Path]:
    """The .db3 and .mcap files of a folder, in the order of the numbers in their names."""

    def natural_order(path: Path) -> list[Any]:
        # Numbers and other text alternate, so a number is always compared with a number.
        return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]

    wanted = re.compile(r".*\.(db3|mcap)(\.zstd?)?", re.IGNORECASE)
    found = {path for path in folder.iterdir() if wanted.fullmatch(path.name) and path.is_file()}
    # A file that was decompressed beside its compressed file is not read twice.
    return sorted((path for path in found if not _is_packed_twin(path, found)), key=natural_order)


def _is_packed_twin(path: Path, found: set[Path]) -> bool:
    return path.suffix.lower() in (".zst", ".zstd") and path.with_suffix("") in found


def _named_files(metadata: Path) -> list[str]:
    """The files that a metadata.yaml names; none if it is missing or cannot be read."""
    import yaml

    try:
        content = yaml.safe_load(metadata.read_bytes())
        named = content["rosbag2_bagfile_information"]["relative_file_paths"]
    except (OSError, yaml.YAMLError, ValueError, RecursionError, LookupError, TypeError):
        return []
    is_list = isinstance(named, list) and all(isinstance(name, str) and Path(name).name for name in named)
    return named if is_list else []


def _find_named_file(folder: Path, name: str) -> Path:
    """Find a file that metadata.yaml names; it may have been compressed or decompressed since.

    Raises:
        InputError: there is no such file.
    """
    names = (name, f"{name}.zstd", name.removesuffix(".zstd"))
    places = [folder / place for each in names for place in (Path(each).name, each)]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise InputError(
            f"{folder}: {METADATA} names {name}, which is not there; copy it too, or move {METADATA} away to "
            "read the files that are there"
        )
    return found


def _open_file(path: Path, stack: ExitStack) -> BagFile:
    head = read_head(path)
    if not head:
        raise InputError(f"{path}: is empty; {REPAIR_ADVICE}, but not an empty file: copy or record it again")
    if head.startswith(OLD_ROS1):
        raise InputError(
            f"{path}: is a ROS bag in a format before version 2.0 (2010); convert it with ROS 1's 'rosbag "
            "filter OLD NEW True'"
        )
    kind = next((kind for magic, kind in KINDS.items() if head.startswith(magic)), None)
    if kind is None:
        raise InputError(
            f"{path}: is named like a ROS bag, but begins with {head[:16]!r}, unlike bags of ROS 1, sqlite3 "
            "or mcap; give the bag itself, or correct the name of the file"
        )
    unpacked = stack.enter_context(unpacked_file(path))
    try:
        file = kind(unpacked)
    except NoBag as error:
        raise InputError(f"{path}: {error}; give the bag itself") from error
    except (BrokenBag, OSError) as error:
        raise InputError(f"{path}: cannot be opened as a ROS bag ({error}); {REPAIR_ADVICE}") from error
    if file.broken and not file.connections:
        raise InputError(f"{path}: cannot be opened as a ROS bag ({file.broken}); {REPAIR_ADVICE}")
    return file
