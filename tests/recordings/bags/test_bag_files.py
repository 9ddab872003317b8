"""Bags as files: by their first bytes, packed, of several files, cut off."""

import bz2
import gzip
import lzma
import shutil
import sqlite3
import tempfile
from contextlib import closing

import lz4.frame
import numpy as np
import pytest
from backports import zstd
from mcap.writer import CompressionType, IndexType
from rosbags.rosbag1 import Writer as Writer1

from data.make_bag import (
    FORMATS,
    SCAN,
    START,
    arrival_of,
    laser_scan,
    make_bag,
    scan_bytes,
    store_of,
    write_bag,
    write_mcap,
    write_ros1,
)
from data.make_carmen import make_carmen
from rcnn_odom.errors import InputError
from rcnn_odom.recordings import rosbag
from rcnn_odom.recordings.bags.chunks import BrokenBag, _unpack, sort_messages
from rcnn_odom.recordings.formats import open_stream

RANGES = np.random.default_rng(0).uniform(1, 39, (40, 181))
SCAN_CHANNEL = {"/scan": (SCAN, "ros2msg", b"", "cdr")}
MESSAGES = [("/scan", arrival_of(number), scan_bytes(row)) for number, row in enumerate(RANGES)]
PACK = {"gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress, "zstd": zstd.compress}


def read(path):
    return [scan.ranges for scan in open_stream(path).scans]


def check(path, ranges=RANGES):
    np.testing.assert_allclose(read(path), ranges, rtol=1e-6)


def storage(bag):
    return bag if bag.is_file() else next(path for path in bag.iterdir() if path.suffix != ".yaml")


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("name", ["UPPER.BAG", "rec.bag.active", "recording", "notes.log", "x.mcap", "x.db3"])
def test_a_file_is_a_bag_by_its_bytes_not_by_its_name(tmp_path, kind, name):
    shutil.move(storage(make_bag(tmp_path, kind, RANGES)), tmp_path / name)
    assert rosbag.recognises(tmp_path / name)
    check(tmp_path / name)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("packing", PACK)
def test_packed_bags_are_unpacked_and_removed(tmp_path, monkeypatch, kind, packing):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    bag = storage(make_bag(tmp_path, kind, RANGES))
    for name in (f"{bag.name}.{packing}", "packed"):
        (tmp_path / name).write_bytes(PACK[packing](bag.read_bytes()))
        check(tmp_path / name)
        assert not list(scratch.iterdir()), "read to the end"
        stream = open_stream(tmp_path / name)
        next(stream.scans)
        assert list(scratch.iterdir())
        stream.scans.close()
        assert not list(scratch.iterdir()), "closed before the end"
        with pytest.raises(InputError, match="no topic /none; "):
            open_stream(tmp_path / name, {"topic": "/none"})
        assert not list(scratch.iterdir()), "refused"


@pytest.mark.parametrize("name", ["x.bag", "x.mcap", "x.db3", "X.BAG", "x.bag.gz", "x.bag.active"])
@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty; "),
        (
            b"FLASER 3 1 2 3 0 0 0 0 0 0 0 host 0\n",
            "is named like a ROS bag, but begins with b'FLASER 3 1 2 3 ",
        ),
        (bytes(5000), "is named like a ROS bag, but begins with"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0", "is a pointer of Git LFS"),
        (b"PK\x03\x04 and so on", "is a zip archive; "),
        (b"#ROSBAG V1.2\n", "a format before version 2.0 .*; convert it with ROS 1's 'rosbag filter"),
        (b"\x89MCAP0\r\n", "cannot be opened as a ROS bag .*; .* 'mcap recover'"),
        (b"#ROSBAG V2.0\n", "cannot be opened as a ROS bag .*; .* 'rosbag reindex'"),
        (b"SQLite format 3\0", "cannot be opened as a ROS bag .*; "),
    ],
)
def test_a_file_that_is_no_bag_but_named_like_one(tmp_path, name, content, says):
    path = tmp_path / name
    is_told_at_once = content.startswith((b"version", b"PK"))
    path.write_bytes(gzip.compress(content) if name.endswith("gz") and not is_told_at_once else content)
    assert rosbag.recognises(path)
    with pytest.raises(InputError, match=says) as raised:
        open_stream(path)
    assert "\n" not in str(raised.value)


def test_other_files_are_no_bags(tmp_path):
    make_carmen(tmp_path, "robot", frames=3)
    assert not rosbag.recognises(tmp_path / "robot.log")
    assert not rosbag.recognises(tmp_path)
    (tmp_path / "rec.zip").write_bytes(b"PK\x03\x04")
    assert not rosbag.recognises(tmp_path / "rec.zip")


def make_split(folder, kind, numbers=(0, 1, 2, 10)):
    """A bag of files of 10 scans each, named by numbers whose order as text is another."""
    bag = folder / "split"
    bag.mkdir()
    for place, number in enumerate(numbers):
        part = folder / f"part{place}"
        part.mkdir()
        whole = make_bag(part, kind, RANGES[10 * place : 10 * place + 10])
        inside = storage(whole)
        shutil.move(inside, bag / f"split_{number}{inside.suffix}")
    return bag


def write_metadata(bag, names):
    listed = "".join(f"\n    - {name}" for name in names)
    text = f"rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:{listed}\n"
    (bag / "metadata.yaml").write_text(text)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_the_folder_of_a_bag(tmp_path, kind):
    bag = make_bag(tmp_path, kind, RANGES)
    for path in (bag, storage(bag), bag / "metadata.yaml"):
        assert rosbag.recognises(path)
        check(path)
    for content in (b"\xff\xfe", b"", b"rosbag2_bagfile_information: {", b"a: 1", b"- 1", b"[" * 500):
        (bag / "metadata.yaml").write_bytes(content)
        check(bag)
        check(bag / "metadata.yaml")


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_a_bag_of_several_files(tmp_path, kind):
    bag = make_split(tmp_path, kind)
    suffix = next(bag.iterdir()).suffix
    check(bag)  # without metadata.yaml, in the order of the numbers
    assert open_stream(bag).total == 40
    names = [f"split_{number}{suffix}" for number in (10, 0)]
    write_metadata(bag, names)
    check(bag, np.concatenate([RANGES[30:], RANGES[:10]]))
    write_metadata(bag, [f"old_folder/{name}" for name in names])  # as ROS 2 Foxy wrote them
    check(bag, np.concatenate([RANGES[30:], RANGES[:10]]))
    packed = bag / f"split_0{suffix}"
    (bag / f"split_0{suffix}.zstd").write_bytes(zstd.compress(packed.read_bytes()))
    packed.unlink()
    check(bag, np.concatenate([RANGES[30:], RANGES[:10]]))
    write_metadata(bag, [*names, f"split_3{suffix}"])
    with pytest.raises(InputError, match=rf"metadata\.yaml names split_3{suffix}, which is not there; "):
        open_stream(bag)
    (bag / "metadata.yaml").unlink()
    check(bag)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
@pytest.mark.parametrize("packing", ["zst", "zstd"])
def test_a_file_and_its_packed_twin_are_read_once(tmp_path, kind, packing):
    bag = make_split(tmp_path, kind)
    for path in list(bag.iterdir()):
        (bag / f"{path.name}.{packing}").write_bytes(zstd.compress(path.read_bytes()))
    check(bag)
    next(bag.glob("split_1.*[!dt]")).unlink()
    check(bag)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_the_files_that_are_read_are_told(tmp_path, kind):
    bag = make_split(tmp_path, kind)
    suffix = next(bag.iterdir()).suffix
    names = ", ".join(f"split_{number}{suffix}" for number in (0, 1, 2, 10))
    assert open_stream(bag).notes == ("40 scans of /scan", f"4 files: {names}")
    (bag / "metadata.yaml").write_bytes(b"\xff garbage")
    garbage = f"metadata.yaml names no files that can be read; files in the folder are read: {names}"
    assert open_stream(bag).notes == ("40 scans of /scan", garbage)
    write_metadata(bag, [f"split_2{suffix}"])
    assert open_stream(bag).notes == ("10 scans of /scan",)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
@pytest.mark.parametrize("size", [0, 10, 100, 300])
@pytest.mark.parametrize("number", [0, 1, 10])
def test_a_file_of_a_split_bag_that_was_hardly_begun(tmp_path, kind, size, number):
    bag = make_split(tmp_path, kind)
    [tiny] = bag.glob(f"split_{number}.*")
    tiny.write_bytes(tiny.read_bytes()[:size])
    place = (0, 1, 2, 10).index(number)
    kept = np.delete(RANGES, np.arange(10 * place, 10 * place + 10), axis=0)
    stream, scans = open_stream(bag), []
    assert stream.total == 30
    with pytest.raises(InputError, match=rf"breaks off after 30 scans \({tiny.name}: .*\); .*reindex"):
        scans.extend(stream.scans)
    np.testing.assert_allclose([scan.ranges for scan in scans], kept, rtol=1e-6)
    for path in bag.iterdir():
        path.write_bytes(path.read_bytes()[: min(size, 10)])
    with pytest.raises(InputError, match=r"split_0\.\w+: (is empty|is named like|cannot be opened)"):
        open_stream(bag)


def test_what_comes_after_the_end_of_mcap_is_not_dropped_in_silence(tmp_path):
    path = write_mcap(tmp_path / "log.mcap", SCAN_CHANNEL, MESSAGES)
    whole = path.read_bytes()
    for rest, says in (
        (whole, "something follows after its end"),
        (b"\0", "something follows after its end"),
        (None, "it ends within a record"),
    ):
        path.write_bytes(whole[:-3] if rest is None else whole + rest)
        stream, scans = open_stream(path), []
        with pytest.raises(InputError, match=f"breaks off after 40 scans .{says}"):
            scans.extend(stream.scans)
        np.testing.assert_allclose([scan.ranges for scan in scans], RANGES, rtol=1e-6)
    path.write_bytes(whole[:-8] + b"12345678")
    with pytest.raises(InputError, match=r"breaks off after 40 scans .a record of it is damaged"):
        read(path)


@pytest.mark.parametrize("packing", ["zstd", "bz2", "lz4"])
def test_a_chunk_of_several_frames(packing):
    compress = {"zstd": zstd.compress, "bz2": bz2.compress, "lz4": lz4.frame.compress}[packing]
    content = np.random.default_rng(3).bytes(5000)
    frames = b"".join(compress(content[at : at + 1000]) for at in range(0, 5000, 1000))
    assert _unpack(frames, packing) == content
    assert content.startswith(_unpack(frames[:-100], packing))


@pytest.mark.parametrize("name", ["x.db3", "browser history"])
@pytest.mark.parametrize("table", ["sites (id INTEGER)", "topics (id INTEGER)"])
def test_another_database_is_no_bag(tmp_path, name, table):
    with closing(sqlite3.connect(tmp_path / name)) as database, database:
        database.execute(f"CREATE TABLE {table}")
    with pytest.raises(
        InputError, match=r"is a database of sqlite3, but not a ROS bag \(no such .*; give"
    ) as told:
        open_stream(tmp_path / name)
    assert "reindex" not in str(told.value)


def test_a_folder_with_metadata_alone(tmp_path):
    (tmp_path / "metadata.yaml").write_text("a: 1")
    with pytest.raises(InputError, match=r"no \.db3 or \.mcap file beside metadata\.yaml; "):
        open_stream(tmp_path)


@pytest.mark.parametrize("mode", ["message", "file"])
@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_bags_that_ros2_packed(tmp_path, kind, mode):
    store = store_of(kind)
    scans = [
        ("/scan", arrival_of(n), laser_scan(store, row, START, 180.0, False)) for n, row in enumerate(RANGES)
    ]
    check(write_bag(tmp_path, kind, {"/scan": SCAN}, scans, compression=mode))


@pytest.mark.parametrize("packing", [Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4])
def test_packed_chunks_of_ros1(tmp_path, packing):
    store = store_of("ros1")
    scans = [
        ("/scan", arrival_of(n), laser_scan(store, row, START, 180.0, True)) for n, row in enumerate(RANGES)
    ]
    bag = write_bag(tmp_path, "ros1", {"/scan": SCAN}, scans, compression=packing)
    check(bag)
    bag.write_bytes(bag.read_bytes()[: bag.stat().st_size // 2])
    with pytest.raises(InputError, match=r"breaks off|cannot be opened"):
        read(bag)


@pytest.mark.parametrize("packing", list(CompressionType))
@pytest.mark.parametrize("index_types", [IndexType.ALL, IndexType.NONE])
@pytest.mark.parametrize("summary", [True, False])
@pytest.mark.parametrize("chunks", [True, False])
def test_mcap_with_and_without_chunks_index_and_summary(tmp_path, packing, index_types, summary, chunks):
    path = write_mcap(
        tmp_path / "log.mcap",
        SCAN_CHANNEL,
        MESSAGES,
        compression=packing,
        index_types=index_types,
        repeat_channels=summary,
        repeat_schemas=summary,
        use_statistics=summary,
        use_summary_offsets=summary,
        use_chunking=chunks,
        chunk_size=4000,
    )
    stream = open_stream(path)
    assert stream.total == 40
    check(path)


def test_messages_come_in_the_order_of_time_where_chunks_overlap(tmp_path):
    order = np.random.default_rng(1).permutation(40)
    shuffled = [MESSAGES[number] for number in order]
    check(write_mcap(tmp_path / "log.mcap", SCAN_CHANNEL, shuffled, chunk_size=4000))
    check(write_mcap(tmp_path / "loose.mcap", SCAN_CHANNEL, shuffled, use_chunking=False))


def test_chunks_that_do_not_overlap_are_not_held_in_memory():
    opened = []

    def chunk(number):
        opened.append(number)
        return [(10 * number + i, 0, memoryview(b"")) for i in (3, 1)]

    messages = sort_messages((10 * number, lambda number=number: chunk(number)) for number in (2, 0, 1))
    assert [next(messages)[0] for _ in range(3)] == [1, 3, 11]
    assert opened == [0, 1]

    def broken():
        yield 5, 0, memoryview(b"")
        raise BrokenBag("it ends")

    messages = sort_messages([(0, broken), (10, lambda: chunk(1))])
    assert next(messages)[0] == 5
    with pytest.raises(BrokenBag):
        next(messages)


@pytest.mark.parametrize("packing", list(CompressionType))
@pytest.mark.parametrize("part", [0.3, 0.5, 0.9, 0.99])
def test_mcap_that_is_cut_off_gives_what_is_there(tmp_path, packing, part):
    noise = np.random.default_rng(2).uniform(1, 39, (100, 1081))  # which cannot be packed well
    messages = [("/scan", arrival_of(number), scan_bytes(row)) for number, row in enumerate(noise)]
    path = write_mcap(tmp_path / "log.mcap", SCAN_CHANNEL, messages, compression=packing, chunk_size=80_000)
    path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
    stream, scans = open_stream(path), []
    with pytest.raises(
        InputError, match=r"breaks off after .* scans .*; these scans are kept; .*mcap recover"
    ):
        scans.extend(stream.scans)
    assert (part - 0.25) * 100 < len(scans) <= part * 100 + 1
    np.testing.assert_allclose([scan.ranges for scan in scans], noise[: len(scans)], rtol=1e-6)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("part", [0.0, 0.02, 0.3, 0.6, 0.9])
def test_a_bag_that_is_cut_off_is_told_with_a_way_out(tmp_path, kind, part):
    bag = make_bag(tmp_path, kind, RANGES)
    inside = storage(bag)
    inside.write_bytes(inside.read_bytes()[: int(part * inside.stat().st_size)])
    scans = []
    says = r"(is empty|cannot be opened as a ROS bag|breaks off (after|before)).*; .*reindex.* recover"
    with pytest.raises(InputError, match=says):
        scans.extend(open_stream(bag).scans)
    if part >= 0.6:
        assert 4 < len(scans) < 40
    for scan, row in zip(scans, RANGES, strict=False):
        np.testing.assert_allclose(scan.ranges, row, rtol=1e-6)


@pytest.mark.parametrize("kind", ["ros1", "ros1 not closed", "mcap"])
def test_every_whole_message_before_a_cut_is_given(tmp_path, kind):
    rows = RANGES[:8, :9]
    contents = [scan_bytes(row, ros1=kind != "mcap") for row in rows]
    path, cut_off = tmp_path / "whole", tmp_path / "cut_off"
    if kind == "mcap":
        messages = [("/scan", arrival_of(number), content) for number, content in enumerate(contents)]
        write_mcap(path, SCAN_CHANNEL, messages, compression=CompressionType.NONE, chunk_size=400)
    else:
        connections = [(b"/scan", b"sensor_msgs/LaserScan", b""), (b"/words", b"std_msgs/String", b"")]
        messages = [(0, arrival_of(number), content) for number, content in enumerate(contents)]
        write_ros1(path, connections, messages, index=kind == "ros1")
    whole = path.read_bytes()
    for cut in range(50, len(whole), 13):
        cut_off.write_bytes(whole[:cut])
        scans = []
        with pytest.raises(InputError, match=r"breaks off|cannot be opened"):
            scans.extend(rosbag.stream(cut_off).scans)
        assert len(scans) == sum(content in whole[:cut] for content in contents), cut


def test_a_damaged_chunk_is_not_believed(tmp_path):
    path = write_mcap(
        tmp_path / "log.mcap", SCAN_CHANNEL, MESSAGES, compression=CompressionType.NONE, chunk_size=4000
    )
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(content)
    with pytest.raises(
        InputError, match=r"breaks off after 2\d scans .a chunk of it is damaged: its checksum"
    ):
        read(path)


def test_a_log_beside_a_database_is_read_too(tmp_path):
    bag = make_bag(tmp_path, "sqlite3", RANGES[:39])
    path = storage(bag)
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA wal_autocheckpoint = 0")
    insert = "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)"
    database.execute(insert, (arrival_of(39), MESSAGES[39][2]))
    database.commit()
    cut_off = tmp_path / "cut_off"  # as a recorder leaves it whose computer loses its power
    shutil.copytree(bag, cut_off)
    database.close()
    assert next(cut_off.glob("*-wal")).stat().st_size
    check(cut_off)
    assert len(list(cut_off.glob("*-wal"))) == 1
