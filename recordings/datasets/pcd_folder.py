"""A folder of PCD clouds, as OmniMapper's evaluation mode reads TUM RGB-D sequences.

DIR/associated.txt     lines that begin with a stamp [s] and end with a cloud's file; may be absent
DIR/*.pcd              without that list, each is named for its stamp: seconds, or whole nanoseconds
DIR/groundtruth.txt    `stamp x y z qx qy qz qw`; may be absent
"""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from mapstream.recordings.cloud_files import read_pcd
from mapstream.recordings.datasets.conversion import (
    Notices,
    Progress,
    Topical,
    drop_notice,
    write_in_order,
)
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.trajectory_files import read_tum
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LidarScan

LIST, TRUTH = "associated.txt", "groundtruth.txt"
_NANOSECONDS_FROM = 10**12  # no recording has so many seconds


def convert_pcd_folder(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write each cloud on `/points`, and the truth, if there is one, on `/truth`."""
    clouds = sorted(_listed(source) if (source / LIST).is_file() else _named(source))
    if not clouds:
        raise RecordingError(f"{source}: expected .pcd clouds, or a list of them in {LIST}")
    dropped = [0]
    streams: list[Iterator[Topical]] = [_scans(clouds, dropped)]
    if (source / TRUTH).is_file():
        truth = read_tum(source / TRUTH)
        streams.append(
            ("/truth", Odometry(stamp_ns=int(stamp_ns), T_odom_base=SE3(pose)))
            for stamp_ns, pose in zip(truth.stamps_ns, truth.poses, strict=True)
        )
    write_in_order(writer, streams, (clouds[0][0], clouds[-1][0]), on_progress)
    return drop_notice(dropped[0])


def _scans(clouds: list[tuple[int, Path]], dropped: list[int]) -> Iterator[Topical]:
    for stamp_ns, file in clouds:
        cloud = read_pcd(file)
        finite = np.isfinite(cloud.points).all(axis=1)
        dropped[0] += int((~finite).sum())
        intensity = None if cloud.intensity is None else cloud.intensity[finite]
        yield (
            "/points",
            LidarScan(stamp_ns=stamp_ns, points=cloud.points[finite], intensity=intensity),
        )


def _listed(source: Path) -> Iterator[tuple[int, Path]]:
    for number, line in enumerate((source / LIST).read_text(encoding="utf-8").splitlines(), 1):
        words = line.split()
        if not words or line.startswith("#"):
            continue
        file = source / words[-1]
        if file.suffix != ".pcd" or not file.is_file():
            raise RecordingError(f"{source / LIST}:{number}: {words[-1]} is no .pcd cloud there")
        yield _stamp_ns(words[0], f"{source / LIST}:{number}"), file


def _named(source: Path) -> Iterator[tuple[int, Path]]:
    for file in source.glob("*.pcd"):
        yield _stamp_ns(file.stem, str(file)), file


def _stamp_ns(text: str, where: str) -> int:
    try:
        value = Decimal(text)
    except InvalidOperation as error:
        raise RecordingError(f"{where}: expected a stamp, found {text!r}") from error
    return int(value) if value >= _NANOSECONDS_FROM else int(value * 10**9)
