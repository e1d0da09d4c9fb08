"""Objects that a detector found in every image of a TUM RGB-D sequence, as the data of EAO-SLAM has them.

    DIR/yolo_txts.tar.gz         a file `STAMP.txt` for each image, see `object_boxes.py`; or a folder yolo_txts
    DIR/groundtruth.txt          `stamp x y z qx qy qz qw`, of the colour camera; may be absent
    DIR/*/STAMP.png              images, as many as there are
    DIR/*.yaml                   the camera, as for `tum_rgbd.py`

Source: Wu et al., EAO-SLAM: Monocular Semi-Dense Object SLAM Based on Ensemble Data Association, IROS 2020.
"""

from __future__ import annotations

import tarfile
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path, PurePath

from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.datasets.conversion import Notices, Progress, Topical, write_in_order
from mapstream.recordings.datasets.image_files import image_of
from mapstream.recordings.datasets.object_boxes import read_boxes
from mapstream.recordings.datasets.tum_cameras import FRAME, SIZE_PX, read_rig
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.odometry_files import read_odometry
from mapstream.streams.errors import RecordingError

_COLOR, _OBJECTS, _TRUTH = "/color/image", "/color/objects", "/truth"
_FOLDER = "yolo_txts"


def has_objects(source: Path) -> bool:
    """Tell whether a folder is laid out in this way."""
    return (source / _FOLDER).is_dir() or (source / f"{_FOLDER}.tar.gz").is_file()


def convert_tum_objects(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/color/objects`, `/truth` and the images that there are, and attach the sensor file."""
    rig, notices = read_rig(source)
    attach_rig(writer, rig)
    texts = sorted((_stamp_ns(place), place, content) for place, content in _texts(source))
    if not texts:
        raise RecordingError(f"{source / _FOLDER}: expected files STAMP.txt, found none")
    images = {path.stem: path for path in source.glob("*/*.png")}
    truth = source / "groundtruth.txt"
    poses = read_odometry(truth) if truth.is_file() else []
    streams: list[Iterator[Topical]] = [
        (
            (_COLOR, image_of(images[place.stem], stamp_ns, FRAME))
            for stamp_ns, place, _ in texts
            if place.stem in images
        ),
        (
            (_OBJECTS, read_boxes(content, place, stamp_ns, frame=FRAME, size_px=SIZE_PX))
            for stamp_ns, place, content in texts
        ),
        ((_TRUTH, pose) for pose in poses),
    ]
    write_in_order(writer, streams, (texts[0][0], texts[-1][0]), on_progress)
    return notices if poses else (*notices, "there is no ground truth")


def _texts(source: Path) -> Iterator[tuple[PurePath, str]]:
    """Yield each file of boxes and its text."""
    folder, archive = source / _FOLDER, source / f"{_FOLDER}.tar.gz"
    if folder.is_dir():
        for path in folder.glob("*.txt"):
            yield path, path.read_text(encoding="utf-8")
        return
    try:
        with tarfile.open(archive) as members:
            for member in members:
                content = members.extractfile(member)
                if content is not None and member.name.endswith(".txt"):
                    yield PurePath(archive, member.name), content.read().decode()
    except (tarfile.TarError, OSError, EOFError, UnicodeDecodeError) as error:
        raise RecordingError(f"{archive}: cannot be read: {error}") from error


def _stamp_ns(place: PurePath) -> int:
    try:
        return int(Decimal(place.stem) * 10**9)
    except InvalidOperation as error:
        raise RecordingError(f"{place}: expected a name like 1341847980.722988.txt") from error
