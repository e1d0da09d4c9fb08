"""TUM RGB-D: colour and depth of a Kinect, registered to each other, and motion capture.

    DIR/rgb.txt, depth.txt       `stamp file`, stamps in seconds
    DIR/groundtruth.txt          `stamp x y z qx qy qz qw`, of the colour camera; may be absent
    DIR/truth_cam_poses.txt      the same of key frames, as CubeSLAM has them: line k is of image k, whose listings
                                 then have numbers in the place of stamps
    DIR/yolov3_bbox.txt          of key frames: `k file`, boxes around a cabinet, see `object_boxes.py`; may be absent
    DIR/*.yaml                   `Camera.fx: ...`, as ORB-SLAM has it; without it the published calibration of the
                                 Freiburg camera (1, 2 or 3) that the name of the folder tells

Depth (5000 to the metre, 0 where nothing was seen) becomes millimetres: half a millimetre is less than the sensor's own
steps from 0.5 m on.
Source: Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012, and
cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats.
"""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.datasets.conversion import Notices, Progress, Topical, write_in_order
from mapstream.recordings.datasets.image_files import depth_of, image_of
from mapstream.recordings.datasets.object_boxes import read_boxes
from mapstream.recordings.datasets.tum_cameras import FRAME, SIZE_PX, read_rig
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.odometry_files import read_odometry
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.objects import ObjectDetections

COLOR, DEPTH, OBJECTS, TRUTH = "/color/image", "/depth/image", "/color/objects", "/truth"
_BOXES = "yolov3_bbox.txt"
_LABEL = "cabinet"  # the one object of these key frames, whose boxes have no class
_UNITS_PER_M = 5000.0
_Listed = list[tuple[int, Path]]  # stamps and files


def convert_tum_rgbd(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/color/image`, `/depth/image` in millimetres `/truth` and `/color/objects`, and attach the sensor file."""
    colors, depths = (_listed(source / name) for name in ("rgb.txt", "depth.txt"))
    rig, notices = read_rig(source)
    attach_rig(writer, rig)
    key_frames = source / "truth_cam_poses.txt"
    truth = key_frames if key_frames.is_file() else source / "groundtruth.txt"
    poses = read_odometry(truth) if truth.is_file() else []
    boxes: _Listed = []
    if truth == key_frames:
        stamps_ns = np.array([pose.stamp_ns for pose in poses], np.int64)
        colors, depths = (_at(stamps_ns, listed, truth) for listed in (colors, depths))
        if (source / _BOXES).is_file():
            boxes = _at(stamps_ns, _listed(source / _BOXES), truth)
    streams: list[Iterator[Topical]] = [
        ((COLOR, image_of(path, stamp_ns, FRAME)) for stamp_ns, path in colors),
        (
            (DEPTH, depth_of(path, stamp_ns, FRAME, units_per_m=_UNITS_PER_M))
            for stamp_ns, path in depths
        ),
        ((OBJECTS, _objects(path, stamp_ns)) for stamp_ns, path in boxes),
        ((TRUTH, pose) for pose in poses),
    ]
    write_in_order(writer, streams, (colors[0][0], colors[-1][0]), on_progress)
    return notices if poses else (*notices, "there is no ground truth")


def _objects(path: Path, stamp_ns: int) -> ObjectDetections:
    try:
        content = path.read_text(encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error
    return read_boxes(content, path, stamp_ns, frame=FRAME, size_px=SIZE_PX, label=_LABEL)


def _listed(path: Path) -> _Listed:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise RecordingError(
            f"{path}: expected the listing of a TUM RGB-D folder: {error}"
        ) from error
    listed: _Listed = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        stamp, _, name = line.strip().partition(" ")
        try:
            listed.append((int(Decimal(stamp) * 10**9), path.parent / name.strip()))
        except InvalidOperation as error:
            raise RecordingError(
                f"{path}:{number}: expected a stamp and a file, found {line!r}"
            ) from error
    if not listed:
        raise RecordingError(f"{path}: expected lines with a stamp and a file, found none")
    return listed


def _at(stamps_ns: IntArray, listed: _Listed, truth: Path) -> _Listed:
    """Give images the stamps of the poses on the same lines."""
    if len(listed) != len(stamps_ns):
        raise RecordingError(
            f"{truth}: expected a pose for each of {len(listed)} images, found {len(stamps_ns)}"
        )
    return [
        (stamp_ns, path) for stamp_ns, (_, path) in zip(stamps_ns.tolist(), listed, strict=True)
    ]
