"""EuRoC MAV sequences: IMU, truth and images, in the ASL layout or as single files.

    DIR[/mav0]/imu0/data.csv, sensor.yaml             or DIR/*.csv, *.txt with the header of such a file
    DIR[/mav0]/camN/data.csv, data/, sensor.yaml      images stay as they are, compressed
    DIR[/mav0]/state_groundtruth_estimate0/data.csv   or DIR/gt*.csv, gt*.txt, but for those of cameras

The base is the body, where the IMU sits. Truth with 16 columns has velocity and biases as well.
Source: Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 2016.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.datasets.conversion import (
    Notices,
    Progress,
    Topical,
    imu_batches,
    write_in_order,
)
from mapstream.recordings.datasets.euroc_sensors import read_rig
from mapstream.recordings.datasets.image_files import image_of
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.number_tables import read_stamped_table
from mapstream.recordings.odometry_files import read_odometry
from mapstream.streams.errors import RecordingError

_IMU_HEADER = "#timestamp [ns],w_RS_S_x"


@dataclass(frozen=True, slots=True)
class _Parts:
    """Where the parts of a sequence lie."""

    imu: Path
    cameras: tuple[Path, ...]  # folders
    truth: Path | None


def convert_euroc(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/imu`, `/truth` and `/camN/image`, and attach the sensor file where there is one."""
    parts, notices = _find(source)
    stamps_ns, values = read_stamped_table(parts.imu, 6, separator=",")
    folders = [parts.imu.parent, *parts.cameras]
    rig, sensor_notices = read_rig([f for f in folders if (f / "sensor.yaml").is_file()])
    if rig is not None:
        attach_rig(writer, rig)
    streams = [imu_batches("/imu", stamps_ns, values[:, :3], values[:, 3:])]
    streams += [_images(folder) for folder in parts.cameras]
    if parts.truth is not None:
        streams.append(_truth(parts.truth))
    write_in_order(writer, streams, (int(stamps_ns[0]), int(stamps_ns[-1])), on_progress)
    return (*notices, *sensor_notices)


def _find(source: Path) -> tuple[_Parts, Notices]:
    root = source / "mav0" if (source / "mav0").is_dir() else source
    imu = root / "imu0" / "data.csv"
    if not imu.is_file():
        imu = next(filter(_is_imu, _texts(source)), imu)
    if not imu.is_file():
        raise RecordingError(
            f"{source}: expected mav0/imu0/data.csv, or a file that begins with {_IMU_HEADER!r};"
            f" found {', '.join(path.name for path in sorted(source.iterdir())) or 'nothing'}"
        )
    cameras = tuple(sorted(path.parent for path in root.glob("cam[0-9]*/data.csv")))
    truth = root / "state_groundtruth_estimate0" / "data.csv"
    named = [
        path for path in _texts(source) if path.name.startswith("gt") and "cam" not in path.name
    ]
    candidates = [path for path in (truth, *named) if path.is_file()]
    if not candidates:
        return _Parts(imu, cameras, None), ("there is no ground truth",)
    notices = tuple(f"{path.name} was left out" for path in candidates[1:])
    return _Parts(imu, cameras, candidates[0]), notices


def _texts(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix in (".csv", ".txt"))


def _is_imu(path: Path) -> bool:
    with path.open(encoding="utf-8", errors="replace") as lines:
        return lines.readline().startswith(_IMU_HEADER)


def _truth(path: Path) -> Iterator[Topical]:
    for pose in read_odometry(path):
        yield "/truth", pose


def _images(folder: Path) -> Iterator[Topical]:
    """Yield the images of a camera, as they are on disk."""
    listing = folder / "data.csv"
    for number, line in enumerate(listing.read_text(encoding="utf-8").splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        stamp, _, name = line.partition(",")
        path = folder / "data" / name.strip()
        try:
            image = image_of(path, int(stamp), folder.name)
        except (RecordingError, ValueError) as error:
            raise RecordingError(
                f"{listing}:{number}: expected a stamp and a file: {error}"
            ) from error
        yield f"/{folder.name}/image", image
