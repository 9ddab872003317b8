"""Tiny ROS bags in the real formats, by `rosbags` and `mcap`, or byte by byte where these write no such."""

import struct
from functools import cache
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

FORMATS = ("ros1", "sqlite3", "mcap")
START = 1_700_000_000
SCAN, CLOUD, TEXT = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2", "std_msgs/msg/String"
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
"""Of types of fields of a point cloud, as in sensor_msgs/msg/PointField."""
LZ4 = CompressionType.LZ4


def make_bag(
    folder: Path, kind: str, ranges: np.ndarray, topics=("/scan",), field_of_view_deg=180.0, **changes
) -> Path:
    """Writes scans (N, beams) at 10 Hz on each topic, and a string topic beside them; the bag's path."""
    first = kind == "ros1"
    store = store_of(kind)
    messages = [
        (
            topic,
            arrival_of(number),
            laser_scan(store, row, START + 0.1 * number, field_of_view_deg, first, number, **changes),
        )
        for number, row in enumerate(ranges)
        for topic in topics
    ]
    return write_bag(folder, kind, dict.fromkeys(topics, SCAN), messages)


def make_cloud_bag(folder: Path, kind: str, clouds, topic="/points", **layout) -> Path:
    """Writes point clouds at 10 Hz, each a mapping of field names to arrays; see `point_cloud`."""
    store = store_of(kind)
    messages = [
        (topic, arrival_of(number), point_cloud(store, cloud, START + 0.1 * number, kind == "ros1", **layout))
        for number, cloud in enumerate(clouds)
    ]
    return write_bag(folder, kind, {topic: CLOUD}, messages)


def write_bag(folder: Path, kind: str, topics: dict, messages: list, compression=None) -> Path:
    """Writes messages (topic, arrival, message) on topics of these types, and one on /words."""
    first = kind == "ros1"
    store = store_of(kind)
    path = folder / ("log.bag" if first else f"log_{kind}")
    plugin = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}.get(kind)
    writer = Writer1(path) if first else Writer2(path, version=9, storage_plugin=plugin)
    if compression is not None and first:
        writer.set_compression(compression)
    elif compression is not None:
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        serialize = store.serialize_ros1 if first else store.serialize_cdr
        connections = {
            name: writer.add_connection(name, kind, typestore=store)
            for name, kind in (topics | {"/words": TEXT}).items()
        }
        writer.write(connections["/words"], START * 10**9, serialize(store.types[TEXT](data="hello"), TEXT))
        for topic, arrival, message in messages:
            writer.write(connections[topic], arrival, serialize(message, topics[topic]))
    return path


@cache
def store_of(kind: str):
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    if TRANSFORMS not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    return store


def arrival_of(number: int) -> int:
    return START * 10**9 + 10**8 * number + 1000


def header(store, stamp, first, number=0, frame_id="laser"):
    seconds = int(stamp)
    time = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=round((stamp - seconds) * 1e9))
    sequence = {"seq": number} if first else {}
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id, **sequence)


def laser_scan(store, ranges, stamp, field_of_view_deg, first, number=0, **changes):
    """One message, range_max 40 m; those of odd numbers say when each beam was shot."""
    half = np.deg2rad(field_of_view_deg) / 2
    fields = {
        "header": header(store, stamp, first, number),
        "angle_min": -half,
        "angle_max": half,
        "angle_increment": 2 * half / max(len(ranges) - 1, 1),
        "time_increment": 1e-4 * (number % 2),
        "scan_time": 0.1,
        "range_min": 0.1,
        "range_max": 40.0,
        "ranges": np.asarray(ranges, np.float32),
        "intensities": np.zeros(0, np.float32),
    }
    return store.types[SCAN](**fields | changes)


def odometry(store, pose, stamp, first, robot="base_link"):
    """One message of x and y in metres and heading in radians of a robot."""
    x, y, heading = pose
    make = _maker(store)
    turn = Rotation.from_euler("z", heading).as_quat().tolist()
    zero = make("Vector3", 0.0, 0.0, 0.0)
    at = make("Pose", make("Point", float(x), float(y), 0.0), make("Quaternion", *turn))
    return store.types[ODOMETRY](
        header=header(store, stamp, first, frame_id="odom"),
        child_frame_id=robot,
        pose=make("PoseWithCovariance", at, np.zeros(36)),
        twist=make("TwistWithCovariance", make("Twist", zero, zero), np.zeros(36)),
    )


def static_transforms(store, transforms, first):
    """One message of poses (x, y, z in metres, roll, pitch, yaw in degrees) by (frame, its child)."""
    make = _maker(store)
    stamped = [
        store.types["geometry_msgs/msg/TransformStamped"](
            header=header(store, START, first, frame_id=frame),
            child_frame_id=child,
            transform=make("Transform", make("Vector3", *map(float, pose[:3])), make("Quaternion", *turn)),
        )
        for (frame, child), pose in transforms.items()
        for turn in [Rotation.from_euler("xyz", pose[3:], degrees=True).as_quat().tolist()]
    ]
    return store.types[TRANSFORMS](transforms=stamped)


def _maker(store):
    return lambda name, *values: store.types[f"geometry_msgs/msg/{name}"](*values)


def point_cloud(store, arrays, stamp, first, columns=None, big_endian=False, gap=0, row_gap=0, **changes):
    """One message of arrays (P,) by the names of their fields.

    `gap` bytes lie before each field and at the end of each point, `row_gap` bytes at the end of each row.
    """
    order = ">" if big_endian else "<"
    arrays = {name: np.asarray(values) for name, values in arrays.items()}
    offsets, step = {}, 0
    for name, values in arrays.items():
        offsets[name], step = step + gap, step + gap + values.dtype.itemsize
    step += gap
    points = len(next(iter(arrays.values())))
    width = columns or points
    height = points // width if points else 1
    data = np.full((height, width * step + row_gap), 0xAB, np.uint8)
    for name, values in arrays.items() if points else ():
        packed = values.astype(values.dtype.newbyteorder(order)).reshape(height, width)
        for row in range(height):
            at = np.arange(width)[:, None] * step + offsets[name] + np.arange(values.dtype.itemsize)
            data[row, at] = np.frombuffer(packed[row].tobytes(), np.uint8).reshape(width, -1)
    field = store.types["sensor_msgs/msg/PointField"]
    message = {
        "header": header(store, stamp, first),
        "height": height,
        "width": width,
        "fields": [field(n, offsets[n], CODES[v.dtype.str[1:]], 1) for n, v in arrays.items()],
        "is_bigendian": big_endian,
        "point_step": step,
        "row_step": width * step + row_gap,
        "data": data.ravel(),
        "is_dense": True,
    }
    return store.types[CLOUD](**message | changes)


def scan_bytes(ranges, stamp=START, ros1=False, **changes) -> bytes:
    """A serialized LaserScan over 180 degrees."""
    store = store_of("ros1" if ros1 else "mcap")
    message = laser_scan(store, ranges, stamp, 180.0, ros1, **changes)
    return bytes((store.serialize_ros1 if ros1 else store.serialize_cdr)(message, SCAN))


def write_mcap(path: Path, channels: dict, messages: list, profile="ros2", **options) -> Path:
    """Writes an mcap file of channels, topic -> (schema name, its encoding, its data, message encoding).

    Messages are (topic, arrival, bytes).
    """
    with path.open("wb") as file:
        writer = McapWriter(file, **options)
        writer.start(profile=profile)
        numbers = {}
        for topic, (name, encoding, data, message_encoding) in channels.items():
            schema = writer.register_schema(name, encoding, data)
            numbers[topic] = writer.register_channel(topic, message_encoding, schema, {"qos": "- garbage: ["})
        for topic, arrival, data in messages:
            writer.add_message(numbers[topic], arrival, data, arrival)
        writer.finish()
    return path


def ros1_record(op: int, data: bytes, length=None, **fields) -> bytes:
    """A record of a ROS 1 bag; `length` is written where it is not that of the data."""
    head = ros1_fields(op=bytes([op]), **fields)
    length = len(data) if length is None else length
    return struct.pack("<L", len(head)) + head + struct.pack("<L", length) + data


def ros1_fields(**fields: bytes) -> bytes:
    return b"".join(
        struct.pack("<L", len(name) + 1 + len(value)) + name.encode() + b"=" + value
        for name, value in fields.items()
    )


def write_ros1(
    path: Path, connections: list, messages: list, entry_bytes=12, index=True, latching=b"1"
) -> Path:
    """Writes a ROS 1 bag of one chunk byte by byte.

    Args:
        path: of it.
        connections: (topic, type, definition) as bytes.
        messages: (number of the connection, arrival, bytes).
        entry_bytes: bytes of an entry of the index, as its length says; there are 12.
        index: the recording was closed; otherwise the chunk is not, nor is there an index.
        latching: of all connections.
    """
    fields = [
        {"topic": topic, "type": kind, "md5sum": b"wrong", "message_definition": text, "latching": latching}
        for topic, kind, text in connections
    ]
    defined = b"".join(
        ros1_record(7, ros1_fields(**about), conn=uint32(number), topic=about["topic"])
        for number, about in enumerate(fields)
    )
    chunk, entries = defined, dict.fromkeys(range(len(connections)), b"")
    for number, arrival, data in messages:
        entries[number] += ros1_time(arrival) + uint32(len(chunk))
        chunk += ros1_record(2, data, conn=uint32(number), time=ros1_time(arrival))
    body = ros1_record(5, chunk if index else b"", compression=b"none", size=uint32(len(chunk)))
    counts = {number: len(entry) // 12 for number, entry in entries.items()}
    for number, entry in entries.items() if index else ():
        about = {"ver": uint32(1), "conn": uint32(number), "count": uint32(counts[number])}
        body += ros1_record(4, entry, length=counts[number] * entry_bytes, **about)
    body += b"" if index else chunk
    head = _ros1_head(len(connections), 0)
    end = len(head) + len(body)
    info = ros1_record(
        6,
        b"".join(uint32(number) + uint32(count) for number, count in counts.items()),
        ver=uint32(1),
        chunk_pos=struct.pack("<Q", len(head)),
        start_time=ros1_time(messages[0][1]),
        end_time=ros1_time(messages[-1][1]),
        count=uint32(len(counts)),
    )
    path.write_bytes(_ros1_head(len(connections), end) + body + defined + info if index else head + body)
    return path


def ros1_time(arrival: int) -> bytes:
    return struct.pack("<LL", *divmod(arrival, 10**9))


def uint32(number: int) -> bytes:
    return struct.pack("<L", number)


def _ros1_head(connections: int, index_position: int) -> bytes:
    counts = {"conn_count": uint32(connections), "chunk_count": uint32(1)}
    position = struct.pack("<Q", index_position)
    return b"#ROSBAG V2.0\n" + ros1_record(3, b" " * 64, index_pos=position, **counts)
