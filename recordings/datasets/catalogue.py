"""Converters by name: `kitti:DIR` and so on become MCAP files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mapstream.recordings.datasets.carmen import convert_carmen
from mapstream.recordings.datasets.conversion import Convert, Notices, Progress
from mapstream.recordings.datasets.described_csv import convert_csv
from mapstream.recordings.datasets.eqvio import convert_eqvio, eqvio_file
from mapstream.recordings.datasets.euroc import convert_euroc
from mapstream.recordings.datasets.kitti import convert_kitti
from mapstream.recordings.datasets.kitti_inertial import convert_kitti_inertial, gtsam_data
from mapstream.recordings.datasets.lidar_bins import convert_lidar_bins
from mapstream.recordings.datasets.mines import convert_mines
from mapstream.recordings.datasets.pcd_folder import convert_pcd_folder
from mapstream.recordings.datasets.rawlog import convert_rawlog
from mapstream.recordings.datasets.seven_scenes import convert_seven_scenes
from mapstream.recordings.datasets.tum_objects import convert_tum_objects, has_objects
from mapstream.recordings.datasets.tum_rgbd import convert_tum_rgbd
from mapstream.recordings.mcap_whole import whole_mcap
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.odometry_files import read_odometry
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Converter:
    """One kind of source."""

    summary: str
    convert: Convert
    installed: Callable[[], Path] | None = None  # where the source is if no path is given


def convert_odometry(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write the poses of a text file as `/odometry`, with what else it says of them."""
    poses = read_odometry(source)
    for index, pose in enumerate(poses):
        writer.write("/odometry", pose)
        on_progress((index + 1) / len(poses))
    return ()


def convert_rosbag(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write the messages of any recording as they are, bytes and schemas."""
    with open_recording(source) as recording:
        span_ns = max(1, recording.end_ns - recording.start_ns)
        for message in recording.messages():
            writer.write_raw(message.channel, message.data, message.log_ns)
            on_progress((message.log_ns - recording.start_ns) / span_ns)
        return tuple(f"lost at byte {loss.offset}: {loss.reason}" for loss in recording.losses)


def convert_tum(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write a folder of colour and depth, or of detected objects, or a trajectory."""
    if not source.is_dir():
        return convert_odometry(source, writer, on_progress)
    of_folder = convert_tum_objects if has_objects(source) else convert_tum_rgbd
    return of_folder(source, writer, on_progress)


CONVERTERS = {
    "csv": Converter("CSV whose header names IMU, GNSS, odometry, positions", convert_csv),
    "carmen": Converter("CARMEN log of a planar laser, also .bz2", convert_carmen),
    "eqvio": Converter(
        "30 s of EuRoC V1_01 as feature tracks and IMU from the installed gtsam; needs no PATH",
        convert_eqvio,
        eqvio_file,
    ),
    "euroc": Converter("folder of a EuRoC sequence", convert_euroc),
    "kitti": Converter("folder of KITTI odometry: scans, images or both", convert_kitti),
    "kitti00-gtsam": Converter(
        "470 s of IMU and GPS from the installed gtsam; needs no PATH",
        convert_kitti_inertial,
        gtsam_data,
    ),
    "lidar_bins": Converter("folder of deskewed scans with alidarPose.csv", convert_lidar_bins),
    "mines": Converter("log of Mines ParisTech: planar laser, wheels", convert_mines),
    "pcd": Converter(
        "folder of PCD clouds, with associated.txt or named for stamps", convert_pcd_folder
    ),
    "rawlog": Converter("MRPT rawlog of a planar laser, wheels", convert_rawlog),
    "rosbag": Converter("ROS 1 bag, rosbag2 or MCAP", convert_rosbag),
    "tum": Converter("folder of a TUM RGB-D sequence, or a TUM trajectory", convert_tum),
    "7scenes": Converter("folder of a 7-Scenes sequence", convert_seven_scenes),
}


@dataclass(frozen=True, slots=True)
class Conversion:
    """What came of it."""

    path: Path
    num_messages: int
    notices: Notices


def convert(
    spec: str, out: str | Path, *, on_progress: Callable[[float], None] | None = None
) -> Conversion:
    """Rewrite a data set as MCAP; the file is there whole or not at all.

    Args:
        spec: Kind and place, as `kitti:DIR`; kinds are the keys of `CONVERTERS`. Without a place where the
            source is installed.
        out: The file to write; one that exists is replaced.
        on_progress: Called with the fraction done.

    Raises:
        ConfigError: If the kind is unknown, or there is nothing at the place.
        RecordingError: If the source cannot be read, or the file not be written.
    """
    converter, source = _parsed(spec)
    out = Path(out)
    with whole_mcap(out) as writer:
        notices = converter.convert(source, writer, on_progress or (lambda _: None))
    return Conversion(out, writer.num_messages, notices)


def source_of(spec: str) -> Path:
    """Return the file or folder that a spec names.

    Raises:
        ConfigError: If the kind is unknown, or there is nothing at the place.
        RecordingError: If it should be installed and is not.
    """
    return _parsed(spec)[1]


def _parsed(spec: str) -> tuple[Converter, Path]:
    kind, colon, place = spec.partition(":")
    converter = CONVERTERS.get(kind)
    if converter is not None and (colon or converter.installed is not None):
        source = Path(place) if colon or converter.installed is None else converter.installed()
        if not source.exists():
            raise ConfigError(f"{spec}: there is nothing at {source}")
        return converter, source
    kinds = ", ".join(
        f"{name}:PATH" if found.installed is None else name for name, found in CONVERTERS.items()
    )
    raise ConfigError(f"{spec!r} is no source to convert; expected one of {kinds}")
