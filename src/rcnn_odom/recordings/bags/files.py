"""ROS bags as files: which a bag consists of, of what kind each is, and the messages of a topic."""

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
"""What the folder of a ROS 2 bag holds."""
STORAGE_SUFFIXES = (".db3", ".mcap")
"""Of the files in such a folder."""
SUFFIXES = (".bag", *STORAGE_SUFFIXES)
FURTHER_SUFFIXES = (".active", ".gz", ".bz2", ".xz", ".zst", ".zstd")
"""What may come after them."""
ROS1 = b"#ROSBAG V2"
OLD_ROS1 = (b"#ROSBAG V1", b"#ROSRECORD V1")
BagFile: TypeAlias = ChunkedFile | SqliteFile
KINDS: dict[bytes, Callable[[Path], BagFile]] = {
    ROS1: Ros1File,
    MAGIC: McapFile,
    b"SQLite format 3\0": SqliteFile,
}
"""First bytes of files of bags, and what reads them."""
MENDED_BY = (
    "a bag whose recording was cut off is mended by 'rosbag reindex' or 'ros2 bag reindex', "
    "mcap by 'mcap recover'"
)


class RawMessage(NamedTuple):
    """A message as it is written.

    Attributes:
        encoding: ``ros1``, ``cdr`` or another.
        arrival: nanoseconds.
        content: its bytes.
    """

    encoding: str
    arrival: int
    content: memoryview


class Bag:
    """The files of a bag, one after the other.

    Args:
        files: in their order, each with its name.
        unpacked: removes what was unpacked for them.
        faults: of files that cannot be opened, in words.
        notes: what a user should know of the files.

    Attributes:
        topics: by name, the number of messages of each type.
        broken: what is wrong with files that end too early or cannot be opened; empty where none does.
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
        """Of the messages of a topic that are of a type."""
        connections = [c for _, file in self._files for c in file.connections.values()]
        return {c.encoding for c in connections if (c.topic, c.kind) == (topic, kind)}

    def messages(self, topic: str, kind: str) -> Iterator[RawMessage]:
        """The messages of a topic that are of a type, those of each file in the order of their arrival.

        Raises:
            BrokenBag: a file is damaged or cannot be opened; after the last message that can be read, also of
                the files that come after it.
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
        """Removes what was unpacked."""
        self._unpacked.close()


def is_bag(path: Path) -> bool:
    """Whether it is a file or a folder of a bag by its first bytes, or at least named like one."""
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
    """Opens all files of a bag; of several, those that can be opened.

    Args:
        path: of a file, packed or not; of the folder of a ROS 2 bag, or of the metadata.yaml in it.

    Raises:
        InputError: a file is missing, no bag, or all are so damaged that nothing in them can be read.
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
        faults = tuple(f"{each.name}: {_fault(each, error)}" for each, error in errors.items())
        left_out = tuple(f"left out: {fault}" for fault in faults)
        return Bag(files, stack.pop_all(), faults, (*notes, *left_out))


def _fault(path: Path, error: InputError) -> str:
    """What is wrong, without the file's path and the advice."""
    return str(error).removeprefix(f"{path}: ").partition("; ")[0]


def files_of(path: Path) -> tuple[list[Path], tuple[str, ...]]:
    """The files of a bag in their order, and a note where it is not plain which these are.

    A folder's are those that its metadata.yaml names; where that is missing or cannot be read, all that are
    there, in the order of the numbers in their names.

    Raises:
        InputError: metadata.yaml names a file that is missing, or there is none.
    """
    if path.name == METADATA and path.is_file():
        path = path.absolute().parent
    if path.is_file():
        return [path], ()
    metadata = path / METADATA
    named = _named_files(metadata)
    found = [_find(path, name) for name in named] or _storage_files(path)
    if not found:
        raise InputError(f"{path}: no .db3 or .mcap file beside {METADATA}; copy the files of the bag too")
    listed = ", ".join(file.name for file in found)
    if metadata.exists() and not named:
        return found, (f"{METADATA} names no files that can be read; what is there is read: {listed}",)
    return found, (f"{len(found)} files: {listed}",) if len(found) > 1 else ()


def _is_named_like_bag(path: Path) -> bool:
    name = path.name.lower()
    while name.endswith(FURTHER_SUFFIXES):
        name = name.rpartition(".")[0]
    return name.endswith(SUFFIXES)


def _storage_files(folder: Path) -> list[Path]:
    def natural(path: Path) -> list[Any]:
        # Digits and other text take turns, so that a number is compared with a number.
        return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]

    wanted = re.compile(r".*\.(db3|mcap)(\.zstd?)?", re.IGNORECASE)
    found = {path for path in folder.iterdir() if wanted.fullmatch(path.name) and path.is_file()}
    # What was unpacked beside its packed file is not read twice.
    return sorted((path for path in found if not _is_packed_twin(path, found)), key=natural)


def _is_packed_twin(path: Path, found: set[Path]) -> bool:
    return path.suffix.lower() in (".zst", ".zstd") and path.with_suffix("") in found


def _named_files(metadata: Path) -> list[str]:
    """The files that a metadata.yaml names; none where it is missing or cannot be read."""
    import yaml

    try:
        content = yaml.safe_load(metadata.read_bytes())
        named = content["rosbag2_bagfile_information"]["relative_file_paths"]
    except (OSError, yaml.YAMLError, ValueError, RecursionError, LookupError, TypeError):
        return []
    is_list = isinstance(named, list) and all(isinstance(name, str) and Path(name).name for name in named)
    return named if is_list else []


def _find(folder: Path, name: str) -> Path:
    """The file of this name, unpacked or packed since it was named."""
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
        raise InputError(f"{path}: is empty; {MENDED_BY}, but here is nothing, so copy or record it again")
    if head.startswith(OLD_ROS1):
        raise InputError(
            f"{path}: is a ROS bag of before version 2.0 of the format (2010); rewrite it by ROS 1's 'rosbag "
            "filter OLD NEW True'"
        )
    kind = next((kind for magic, kind in KINDS.items() if head.startswith(magic)), None)
    if kind is None:
        raise InputError(
            f"{path}: is named like a ROS bag, but begins with {head[:16]!r}, as no bag of ROS 1, sqlite3 or "
            "mcap does; give the bag itself, or name the file as what it is"
        )
    unpacked = stack.enter_context(unpacked_file(path))
    try:
        file = kind(unpacked)
    except NoBag as error:
        raise InputError(f"{path}: {error}; give the bag itself") from error
    except (BrokenBag, OSError) as error:
        raise InputError(f"{path}: cannot be opened as a ROS bag ({error}); {MENDED_BY}") from error
    if file.broken and not file.connections:
        raise InputError(f"{path}: cannot be opened as a ROS bag ({file.broken}); {MENDED_BY}")
    return file
