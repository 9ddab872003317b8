"""Tiny ROS bags in the real formats, written by `rosbags`."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

FORMATS = ("ros1", "sqlite3", "mcap")
START = 1_700_000_000


def make_bag(folder: Path, kind: str, ranges: np.ndarray, topics=("/scan",), field_of_view_deg=180.0) -> Path:
    """Writes scans (N, beams) at 10 Hz on each topic, and a string topic beside them; the bag's path."""
    first = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    path = folder / ("log.bag" if first else f"log_{kind}")
    plugin = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}.get(kind)
    with Writer1(path) if first else Writer2(path, version=9, storage_plugin=plugin) as writer:
        serialize = store.serialize_ros1 if first else store.serialize_cdr
        kind_of = dict.fromkeys(topics, "sensor_msgs/msg/LaserScan") | {"/words": "std_msgs/msg/String"}
        connections = {
            name: writer.add_connection(name, kind, typestore=store) for name, kind in kind_of.items()
        }
        text = store.types["std_msgs/msg/String"](data="hello")
        writer.write(connections["/words"], START * 10**9, serialize(text, "std_msgs/msg/String"))
        for number, row in enumerate(ranges):
            for topic in topics:
                scan = laser_scan(store, row, START + 0.1 * number, field_of_view_deg, first, number)
                arrival = START * 10**9 + 10**8 * number + 1000
                writer.write(connections[topic], arrival, serialize(scan, "sensor_msgs/msg/LaserScan"))
    return path


def laser_scan(store, ranges, stamp, field_of_view_deg, first, number):
    """One message, range_max 40 m; those of odd numbers say when each beam was shot."""
    seconds = int(stamp)
    time = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=round((stamp - seconds) * 1e9))
    sequence = {"seq": number} if first else {}
    half = np.deg2rad(field_of_view_deg) / 2
    return store.types["sensor_msgs/msg/LaserScan"](
        header=store.types["std_msgs/msg/Header"](stamp=time, frame_id="laser", **sequence),
        angle_min=-half,
        angle_max=half,
        angle_increment=2 * half / (len(ranges) - 1),
        time_increment=1e-4 * (number % 2),
        scan_time=0.1,
        range_min=0.1,
        range_max=40.0,
        ranges=ranges.astype(np.float32),
        intensities=np.zeros(0, np.float32),
    )
