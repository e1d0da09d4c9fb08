"""Data sets with what a detector found in their images."""

from __future__ import annotations

import tarfile
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapstream.recordings.attached_rig import rig_of
from mapstream.recordings.datasets.catalogue import convert
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import RecordingError
from tests.data import shared
from tests.recordings import made_datasets

_CAMERA = "%YAML:1.0\nCamera.fx: 535.4\nCamera.fy: 539.2\nCamera.cx: 320.1\nCamera.cy: 247.6\nViewer.PointSize:2\n"
_BOXES = {"10.5": "56 0 10 20 30 0.9\n41 600 400 80 90 0.5\n", "11.5": ""}


def decoded(path: Path, topic: str) -> list[Any]:
    with open_recording(path) as recording:
        decode = decoder_for(recording.topics[topic].channel)
        return [decode(message) for message in recording.messages([topic])]


@pytest.fixture
def office(tmp_path: Path) -> Path:
    """Two images' boxes in a folder, and one of the images."""
    folder = tmp_path / "office"
    (folder / "yolo_txts").mkdir(parents=True)
    for stamp, text in _BOXES.items():
        (folder / "yolo_txts" / f"{stamp}.txt").write_text(text)
    (folder / "images").mkdir()
    cv2.imwrite(str(folder / "images" / "11.5.png"), np.zeros((480, 640), np.uint8))
    (folder / "groundtruth.txt").write_text("# t\n10.4 1 2 3 0 0 0 1\n11.6 1 2 4 0 0 0 1\n")
    (folder / "TUM3.yaml").write_text(_CAMERA)
    return folder


def test_recorded_boxes_become_detections(office: Path, tmp_path: Path) -> None:
    done = convert(f"tum:{office}", tmp_path / "out.mcap")

    found, none = decoded(done.path, "/color/objects")
    assert (found.labels, found.stamp_ns) == (("chair", "cup"), 10_500_000_000)
    # pixels are counted from the middle of the first, and boxes end with the image
    np.testing.assert_array_equal(
        found.boxes_px, [[-0.5, 9.5, 19.5, 39.5], [599.5, 399.5, 639.5, 479.5]]
    )
    np.testing.assert_allclose(found.scores, [0.9, 0.5], rtol=1e-6)
    assert (len(none), none.stamp_ns) == (0, 11_500_000_000)
    assert [image.stamp_ns for image in decoded(done.path, "/color/image")] == [11_500_000_000]
    assert len(decoded(done.path, "/truth")) == 2
    camera = rig_of(done.path).camera_of_frame(found.frame)
    assert camera is not None
    assert camera.calibration.focal_px.tolist() == [535.4, 539.2]  # type: ignore[union-attr]  # of a camera


def test_an_archive_of_boxes_is_as_good_as_a_folder(office: Path, tmp_path: Path) -> None:
    convert(f"tum:{office}", tmp_path / "folder.mcap")
    with tarfile.open(office / "yolo_txts.tar.gz", "w:gz") as archive:
        archive.add(office / "yolo_txts", "yolo_txts")
    (office / "yolo_txts").rename(tmp_path / "gone")

    convert(f"tum:{office}", tmp_path / "archive.mcap")

    assert (tmp_path / "archive.mcap").read_bytes() == (tmp_path / "folder.mcap").read_bytes()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("10.5.txt", "80 1 2 3 4 0.5\n", r"10\.5\.txt:1: expected numbers, found '80 1.*out of range"),
        ("10.5.txt", "\n56 1 2 3 4\n", r"10\.5\.txt:2: expected class x_min y_min width height score"),
        ("10.5.txt", "56 1 2 0 4 0.5\n", "expected class x_min"),
        ("10.5.txt", "56 1 2 nan 4 0.5\n", "expected class x_min"),
        ("10.5.txt", "chair 1 2 3 4 0.5\n", "expected numbers"),
        ("ten.txt", "", "expected a name like 1341847980.722988.txt"),
    ],
)  # fmt: skip
def test_wrong_files_of_boxes_are_named(
    office: Path, name: str, text: str, message: str, tmp_path: Path
) -> None:
    (office / "yolo_txts" / name).write_text(text)

    with pytest.raises(RecordingError, match=message):
        convert(f"tum:{office}", tmp_path / "out.mcap")


def test_a_torn_archive_of_boxes_is_refused(office: Path, tmp_path: Path) -> None:
    (office / "yolo_txts").rename(tmp_path / "gone")
    (office / "yolo_txts.tar.gz").write_bytes(b"\x1f\x8b\x08 torn")

    with pytest.raises(RecordingError, match=r"yolo_txts\.tar\.gz: cannot be read"):
        convert(f"tum:{office}", tmp_path / "out.mcap")


def test_key_frames_bring_the_boxes_of_their_cabinet(tmp_path: Path) -> None:
    folder = made_datasets.tum(tmp_path)
    for name, part in (("rgb", "rgb/a.png"), ("depth", "depth/a.png"), ("yolov3_bbox", "box.txt")):
        (folder / f"{name}.txt").write_text(f"# k f\n0 {part}\n")
    (folder / "box.txt").write_text("203\t11\t330\t378\t0.32\n")
    (folder / "truth_cam_poses.txt").write_text("10.5 1 2 3 0 0 0 1\n")

    done = convert(f"tum:{folder}", tmp_path / "out.mcap")

    (found,) = decoded(done.path, "/color/objects")
    assert (found.labels, found.stamp_ns, found.frame) == (("cabinet",), 10_500_000_000, "camera")
    np.testing.assert_array_equal(found.boxes_px, [[202.5, 10.5, 532.5, 388.5]])


@pytest.mark.slow
def test_real_office_with_its_detections(tmp_path: Path) -> None:
    done = convert(f"tum:{shared('tum_fr3_office_objects')}", tmp_path / "out.mcap")

    found = decoded(done.path, "/color/objects")
    labels = Counter(label for detections in found for label in detections.labels)
    assert (len(found), len(decoded(done.path, "/color/image"))) == (2585, 17)
    assert (labels["bottle"], labels["book"], labels["cup"]) == (5372, 2206, 1392)
