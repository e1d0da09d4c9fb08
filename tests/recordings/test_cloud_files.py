"""PLY and PCD: round trips, files of other programs, and refusals."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.recordings.cloud_files import FileCloud, read_pcd, read_ply, write_pcd, write_ply
from mapstream.streams.errors import RecordingError

Write = Callable[..., None]
Read = Callable[[Path], FileCloud]
FORMATS = pytest.mark.parametrize(
    ("write", "read"), [(write_ply, read_ply), (write_pcd, read_pcd)], ids=["ply", "pcd"]
)
POINTS = np.array([[0, 1, 2], [3.5, -4, 5], [1e-3, 1e6, -7]], dtype=np.float32)


@FORMATS
@given(
    seed=st.integers(0, 99), n=st.integers(0, 20), extras=st.tuples(st.booleans(), st.booleans())
)
def test_S3_round_trip(  # pytest and hypothesis name them
    tmp_path_factory: pytest.TempPathFactory,
    write: Write,
    read: Read,
    seed: int,
    n: int,
    extras: tuple[bool, bool],
) -> None:
    """Points, intensity and colours come back bit for bit."""
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 100, (n, 3)).astype(np.float32)
    intensity = rng.random(n).astype(np.float32) if extras[0] else None
    colors = rng.integers(0, 256, (n, 3), dtype=np.uint8) if extras[1] else None
    path = tmp_path_factory.mktemp("c") / "cloud"

    write(path, points, intensity, colors)
    back = read(path)

    np.testing.assert_array_equal(back.points, points)
    for have, want in ((back.intensity, intensity), (back.colors_rgb, colors)):
        assert (have is None) == (want is None)
        if have is not None and want is not None:
            np.testing.assert_array_equal(have, want)


def test_S3_opencv_reads_our_ply(tmp_path: Path) -> None:
    """A second program finds the same points."""
    write_ply(tmp_path / "c.ply", POINTS, [1, 2, 3])

    points = np.asarray(cv2.loadPointCloud(str(tmp_path / "c.ply"))[0]).reshape(-1, 3)

    np.testing.assert_array_equal(points, POINTS)


def test_S3_we_read_ply_of_opencv(tmp_path: Path) -> None:
    """Its ASCII files too."""
    cv2.savePointCloud(str(tmp_path / "c.ply"), POINTS[:, None])

    np.testing.assert_allclose(read_ply(tmp_path / "c.ply").points, POINTS, rtol=1e-5)


def test_S3_pypcd4_reads_our_pcd(tmp_path: Path) -> None:
    """A second program finds the same points and intensities."""
    pypcd4 = pytest.importorskip("pypcd4")
    write_pcd(tmp_path / "c.pcd", POINTS, [1, 2, 3])

    cloud = pypcd4.PointCloud.from_path(tmp_path / "c.pcd")

    np.testing.assert_array_equal(cloud.numpy(("x", "y", "z")), POINTS)
    np.testing.assert_array_equal(cloud.numpy(("intensity",))[:, 0], [1, 2, 3])


def test_reads_ascii_pcd_with_foreign_fields(tmp_path: Path) -> None:
    """Fields of other names and counts are skipped; a packed float colour is taken apart."""
    packed = np.array([0x00102030], np.uint32).view(np.float32)[0]
    (tmp_path / "c.pcd").write_text(
        "# .PCD v.7\nVERSION .7\nFIELDS rgb x y z normal\nSIZE 4 4 4 4 4\nTYPE F F F F F\n"
        "COUNT 1 1 1 1 3\nWIDTH 1\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1\nDATA ascii\n"
        f"{packed!r} 1 2 3 0 0 1\n".replace("np.float32(", "").replace(")", "")
    )

    cloud = read_pcd(tmp_path / "c.pcd")

    assert cloud.points.tolist() == [[1, 2, 3]]
    assert cloud.colors_rgb is not None
    assert cloud.colors_rgb.tolist() == [[0x10, 0x20, 0x30]]


def test_reads_big_endian_ply_with_faces(tmp_path: Path) -> None:
    """Double coordinates, and elements after the vertices that are none of ours."""
    header = (
        "ply\nformat binary_big_endian 1.0\ncomment made elsewhere\nelement vertex 2\n"
        "property double x\nproperty double y\nproperty double z\nproperty uchar red\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.array([(1, 2, 3, 9), (4, 5, 6, 9)], dtype="f8,f8,f8,u1").astype(">f8,>f8,>f8,u1")
    (tmp_path / "c.ply").write_bytes(header.encode() + rows.tobytes() + b"\x03aaaabbbbcccc")

    assert read_ply(tmp_path / "c.ply").points.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (read_ply, b"solid\nend_header\n", "expected 'ply' in the first line"),
        (read_ply, b"ply\nformat ascii 1.0\n", "there is no line 'end_header'"),
        (
            read_ply,
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9000000000\n%send_header\n1234"
            % b"".join(b"property float %c\n" % name for name in b"xyz"),
            "truncated: expected 9000000000 points of 12 bytes, found 4 bytes",
        ),
        (
            read_ply,
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float a\nend_header\n1\n",
            "expected fields x, y, z, found a",
        ),
        (
            read_ply,
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int a\nend_header\n",
            "cannot read the property 'list uchar int a'",
        ),
        (read_pcd, b"VERSION 0.7\nDATA ascii\n", "the header is incomplete: 'FIELDS'"),
        (
            read_pcd,
            b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA binary_compressed\n",
            "found binary_compressed; save it as binary",
        ),
        (
            read_pcd,
            b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA ascii\n1 2 3\n",
            r"expected \(2, 3\) numbers, found \(1, 3\)",
        ),
    ],
)
def test_refusals_name_the_file(tmp_path: Path, read: Read, content: bytes, message: str) -> None:
    """What was expected, what was found, what to do."""
    (tmp_path / "c.bin").write_bytes(content)

    with pytest.raises(RecordingError, match=r"c\.bin: .*" + message):
        read(tmp_path / "c.bin")


@FORMATS
def test_an_absent_file_is_an_error(tmp_path: Path, write: Write, read: Read) -> None:
    """The message names the file."""
    with pytest.raises(RecordingError, match="absent: cannot be read as a cloud"):
        read(tmp_path / "absent")
