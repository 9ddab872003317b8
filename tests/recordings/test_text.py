"""Text files with a byte order mark, or in UTF-16 or UTF-32."""

from pathlib import Path

import numpy as np
import pytest

from data.make_carmen import PACKINGS
from rcnn_odom.errors import InputError
from rcnn_odom.recordings.text import lines_of, need_text
from rcnn_odom.recordings.trajectory import read_kitti, read_lines

POSES = ["1 0 0 1 0 1 0 2 0 0 1 3", "1 0 0 4 0 1 0 5 0 0 1 6"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_trajectories_with_a_byte_order_mark(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("\r\n".join(POSES), encoding=encoding, newline="")
    np.testing.assert_array_equal(read_kitti(path)[:, :3, 3], [[1, 2, 3], [4, 5, 6]])
    assert read_lines(path, "give poses") == POSES


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_utf16_is_refused(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("\n".join(POSES), encoding=encoding)
    for read in (read_kitti, need_text):
        with pytest.raises(InputError, match=r"poses\.txt: is text in UTF-16; save it as UTF-8"):
            read(path)


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("encoding", ["utf-32-le", "utf-32-be"])
def test_utf32_is_refused_by_its_name(tmp_path: Path, encoding: str, mark: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(mark + "\n".join(POSES), encoding=encoding)
    for read in (read_kitti, need_text):
        with pytest.raises(InputError, match=r"poses\.txt: is text in UTF-32; save it as UTF-8"):
            read(path)


def test_an_empty_file_with_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("\n", encoding="utf-8-sig")
    with pytest.raises(InputError, match="is empty; give poses"):
        read_lines(path, "give poses")
    with pytest.raises(InputError, match="is empty; give a recording"):
        need_text(path)


@pytest.mark.parametrize("compress", [None, *PACKINGS])
def test_lines_and_their_numbers(tmp_path: Path, compress: str | None) -> None:
    content = "\ufeffone\r\n\ufefftwo \ufeff\nthree".encode() + b" \xff"
    path = tmp_path / "text"
    path.write_bytes(PACKINGS[compress](content) if compress else content)
    assert need_text(path).startswith(b"one")
    assert list(lines_of(path)) == [(1, "one\n"), (2, "two \ufeff\n"), (3, "three \ufffd")]
