"""What a file is by its first bytes, packed or not."""

import bz2
import gzip
import io
import lzma
import tarfile
import zipfile

import pytest
from backports import zstd

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.packing import is_packed, open_unpacked, read_head, unpacked_file, unpacking_errors

CONTENT = b"FLASER 1 2.0 " * 5000
PACKED = {
    "gzip": gzip.compress(CONTENT),
    "bzip2": bz2.compress(CONTENT),
    "xz": lzma.compress(CONTENT),
    "zstd": zstd.compress(CONTENT),
}


@pytest.fixture(params=sorted(PACKED))
def packed(request, tmp_path):
    path = tmp_path / "without a suffix"
    path.write_bytes(PACKED[request.param])
    return path


def test_packed_files_are_unpacked_whatever_their_name(packed):
    assert is_packed(packed)
    assert CONTENT.startswith(read_head(packed))
    with open_unpacked(packed) as file:
        assert file.read() == CONTENT
    with unpacked_file(packed) as path:
        assert path.read_bytes() == CONTENT
    assert not path.exists()


def test_a_plain_file_stays_where_it_is(tmp_path):
    path = tmp_path / "misleading.gz"
    path.write_bytes(CONTENT)
    assert not is_packed(path)
    with unpacked_file(path) as same:
        assert same == path
    assert path.exists()


def test_a_packed_file_that_is_cut_off(packed):
    packed.write_bytes(packed.read_bytes()[:-20])
    with (
        pytest.raises(InputError, match=r"cannot be unpacked to its end .*; download it again"),
        unpacked_file(packed),
    ):
        pass
    with pytest.raises(unpacking_errors()), open_unpacked(packed) as file:
        assert len(file.read()) == len(CONTENT)


def _zip() -> bytes:
    with zipfile.ZipFile(content := io.BytesIO(), "w") as archive:
        archive.writestr("scans.log", CONTENT)
    return content.getvalue()


def _tar() -> bytes:
    with tarfile.open(fileobj=(content := io.BytesIO()), mode="w:gz") as archive:
        (entry := tarfile.TarInfo("scans.log")).size = len(CONTENT)
        archive.addfile(entry, io.BytesIO(CONTENT))
    return content.getvalue()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (_zip(), "is a zip archive; unpack it"),
        (_tar(), "is a tar archive; unpack it"),
        (
            b"version https://git-lfs.github.com/spec/v1\noid sha256:4d\nsize 12345\n",
            "Git LFS.*; fetch it with git lfs",
        ),
    ],
    ids=["zip", "tar", "pointer"],
)
def test_what_is_no_recording_is_told(tmp_path, content, says):
    (tmp_path / "drive.bag").write_bytes(content)
    with pytest.raises(InputError, match=says):
        read_head(tmp_path / "drive.bag")


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"cannot be read .No such file"):
        read_head(tmp_path / "none")
