"""Occupancy grids as files of map_server: what is written is read again, also as others write it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.recordings.grid_files import read_grid, write_grid
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.grids import FREE, OCCUPIED, UNKNOWN, OccupancyGrid


def grid(
    seed: int, shape: tuple[int, int] = (7, 11), pose: tuple[float, float, float] = (1, -2, 0.3)
) -> OccupancyGrid:
    cells = np.random.default_rng(seed).choice([UNKNOWN, FREE, OCCUPIED], shape)
    return OccupancyGrid(
        stamp_ns=7,
        cells=cells,
        resolution_m=0.05,
        T_map_grid=SE3.from_rotation(so3_exp([0, 0, pose[2]]), [pose[0], pose[1], 0.0]),
    )


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 99),
    rows=st.integers(1, 9),
    columns=st.integers(1, 9),
    x=st.floats(-1e3, 1e3),
    yaw=st.floats(-3.1, 3.1),
)
def test_N11_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    rows: int,
    columns: int,
    x: float,
    yaw: float,
) -> None:
    path = tmp_path_factory.mktemp("grid") / "plan.yaml"
    written = grid(seed, (rows, columns), (x, -x, yaw))

    files = write_grid(path, written)
    found = read_grid(path)

    assert files == (path, path.with_suffix(".pgm"))
    np.testing.assert_array_equal(found.cells, written.cells)
    np.testing.assert_allclose(found.T_map_grid.matrix, written.T_map_grid.matrix, atol=1e-9)
    assert found.resolution_m == written.resolution_m


def test_N11_the_files_are_those_of_map_server(tmp_path: Path) -> None:
    """White is free, black occupied, and the first line of the image is the upper one."""
    cells = np.full((2, 3), FREE)
    cells[0, 0], cells[1, 2] = OCCUPIED, UNKNOWN
    made = OccupancyGrid(stamp_ns=0, cells=cells, resolution_m=0.1)

    write_grid(tmp_path / "plan.yaml", made)

    assert (tmp_path / "plan.pgm").read_bytes() == b"P5\n3 2\n255\n" + bytes(
        [254, 254, 205, 0, 254, 254]
    )
    lines = (tmp_path / "plan.yaml").read_text().splitlines()
    assert "image: plan.pgm" in lines
    assert "mode: trinary" in lines
    assert "resolution: 0.1" in lines
    assert "origin: [0.0, 0.0, 0.0]" in lines
    assert {"negate: 0", "occupied_thresh: 0.65", "free_thresh: 0.196"} <= set(lines)


@pytest.mark.parametrize(
    ("mode", "negate", "expected"),
    [
        ("trinary", 0, [100, -1, 0]),
        ("trinary", 1, [0, -1, 100]),
        ("scale", 0, [100, 60, 0]),
        ("raw", 0, [0, 100, -1]),
    ],
)
def test_modes_and_images_of_others(
    tmp_path: Path, mode: str, negate: int, expected: list[int]
) -> None:
    values = [0, 100, 101] if mode == "raw" else [0, 130, 255]
    cv2.imwrite(str(tmp_path / "a.png"), np.array([values], np.uint8))
    (tmp_path / "a.yaml").write_text(
        f"image: a.png\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: {negate}\nmode: {mode}\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )

    assert read_grid(tmp_path / "a.yaml").cells[0].tolist() == expected


def test_what_is_seen_through_is_unknown(tmp_path: Path) -> None:
    image = np.zeros((1, 2, 4), np.uint8)
    image[0, 0, 3] = 255
    cv2.imwrite(str(tmp_path / "a.png"), image)
    (tmp_path / "a.yaml").write_text(
        "image: a.png\nresolution: 0.1\norigin: [0, 0, 0]\nmode: scale\n"
    )

    assert read_grid(tmp_path / "a.yaml").cells[0].tolist() == [100, -1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image: [", "not YAML"),
        ("image: a.pgm\nresolution: 0\norigin: [0, 0, 0]", "resolution: Input should be greater"),
        ("image: a.pgm\nresolution: 1\norigin: [0, 0]", "origin"),
        ("image: a.pgm\nresolution: 1\norigin: [0, 0, 0]", "the image of the grid cannot be read"),
        ("image: a.yaml\nresolution: 1\norigin: [0, 0, 0]", "not an image of 8 bits"),
    ],
)
def test_refuses_what_is_no_grid(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(text)

    with pytest.raises(RecordingError, match=message):
        read_grid(path)


def test_refuses_to_write_what_the_files_cannot_say(tmp_path: Path) -> None:
    tilted = OccupancyGrid(
        stamp_ns=0,
        cells=np.zeros((1, 1), np.int8),
        resolution_m=1.0,
        T_map_grid=SE3.from_rotation(so3_exp([0.1, 0, 0]), [0, 0, 0]),
    )
    with pytest.raises(RecordingError, match="tilted"):
        write_grid(tmp_path / "a.yaml", tilted)
    with pytest.raises(RecordingError, match=r"written as \.yaml"):
        write_grid(tmp_path / "a.pgm", grid(0))
    with pytest.raises(RecordingError, match="no grid can be read"):
        read_grid(tmp_path / "b.yaml")
