"""A folder of PCD clouds becomes a recording, in the order of its stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.recordings.cloud_files import write_pcd
from mapstream.recordings.datasets.catalogue import convert
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.sensors import LidarScan, Message


def cloud(path: Path, number: int) -> None:
    points = np.full((4, 3), float(number))
    points[3] = np.nan  # an organised cloud saw nothing there
    path.parent.mkdir(exist_ok=True, parents=True)
    write_pcd(path, points)


def messages(file: Path) -> list[tuple[str, Message]]:
    with open_recording(file) as recording:
        decoders = {name: decoder_for(topic.channel) for name, topic in recording.topics.items()}
        return [(raw.topic, decoders[raw.topic](raw)) for raw in recording.messages()]


def test_R6_associated_clouds_and_their_truth_are_read(tmp_path: Path) -> None:
    for number in (1, 2):
        cloud(tmp_path / "set" / "pcd" / f"{number}.pcd", number)
    (tmp_path / "set" / "associated.txt").write_text(
        "# stamp image stamp cloud\n1.5 rgb/a.png 1.501 pcd/2.pcd\n1.0 rgb/b.png 1.001 pcd/1.pcd\n"
    )
    (tmp_path / "set" / "groundtruth.txt").write_text("1.0 0 0 0 0 0 0 1\n1.5 1 0 0 0 0 0 1\n")

    result = convert(f"pcd:{tmp_path / 'set'}", tmp_path / "out.mcap")

    found = messages(tmp_path / "out.mcap")
    assert [(topic, m.stamp_ns) for topic, m in found] == [
        ("/points", 10**9),
        ("/truth", 10**9),
        ("/points", 15 * 10**8),
        ("/truth", 15 * 10**8),
    ]
    scans = [m for _, m in found if isinstance(m, LidarScan)]
    assert [scan.points.tolist() for scan in scans] == [[[1.0] * 3] * 3, [[2.0] * 3] * 3]
    assert result.notices == ("2 points that were not finite were left out",)


def test_R6_clouds_without_a_list_are_named_for_their_stamps(tmp_path: Path) -> None:
    cloud(tmp_path / "set" / "1311868164.363181.pcd", 1)
    cloud(tmp_path / "set" / "1311868164399026000.pcd", 2)

    convert(f"pcd:{tmp_path / 'set'}", tmp_path / "out.mcap")

    stamps_ns = [m.stamp_ns for _, m in messages(tmp_path / "out.mcap")]
    assert stamps_ns == [1311868164363181000, 1311868164399026000]


@pytest.mark.parametrize(
    ("files", "listed", "reason"),
    [
        ([], None, "expected .pcd clouds"),
        (["a.pcd"], None, "a.pcd: expected a stamp, found 'a'"),
        (["1.pcd"], "x 1.pcd\n", "associated.txt:1: expected a stamp, found 'x'"),
        (["1.pcd"], "1 2.pcd\n", "associated.txt:1: 2.pcd is no .pcd cloud there"),
    ],
)
def test_a_folder_that_is_not_understood_is_refused(
    tmp_path: Path, files: list[str], listed: str | None, reason: str
) -> None:
    (tmp_path / "set").mkdir()
    for name in files:
        cloud(tmp_path / "set" / name, 1)
    if listed is not None:
        (tmp_path / "set" / "associated.txt").write_text(listed)

    with pytest.raises(RecordingError, match=reason):
        convert(f"pcd:{tmp_path / 'set'}", tmp_path / "out.mcap")
