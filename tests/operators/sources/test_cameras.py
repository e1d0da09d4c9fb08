"""Images leave a recording with the calibration of their camera, wherever it is described."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapstream.operators.decode.image import ImageDecode, ImageDecodeConfig
from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.operator import Context
from mapstream.operators.sources.mcap import McapSource
from mapstream.operators.sources.mcap_config import McapSourceConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import OperatorError, RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage
from mapstream.streams.messages.vision import ImageFeatures
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraSensor, FeatureSensor
from tests.data import shared

pytestmark = pytest.mark.anyio
_GRAY = np.full((48, 64), 90, np.uint8)


def _camera(focal_px: float, frame: str = "cam") -> CameraCalibration:
    return CameraCalibration(
        stamp_ns=1,
        frame=frame,
        width_px=64,
        height_px=48,
        focal_px=np.full(2, focal_px),
        center_px=np.array([31.5, 23.5]),
        distortion="radtan",
        distortion_parameters=np.array([0.1, 0.0, 0.0, 0.0]),
    )


def _frame(stamp_ns: int = 1000, image: np.ndarray = _GRAY, frame: str = "cam") -> CameraFrame:
    return CameraFrame(stamp_ns=stamp_ns, image=image, encoding="mono8", frame=frame)


def _rig(focal_px: float) -> Rig:
    camera = CameraSensor(
        id="1" * 32, topic="/left/image", frame="cam", calibration=_camera(focal_px)
    )
    features = FeatureSensor(id="2" * 32, topic="/left/features", target_sensor_id=camera.id)
    place = Extrinsics(sensor_id=camera.id, base_sensor_id=camera.id, T_base_sensor=SE3.identity())
    return Rig([camera, features], [place])


def _focal_px(seen: CameraFrame | EncodedImage | ImageFeatures) -> float:
    return float(require_camera(seen).focal_px[0])


async def _played(
    path: Path,
    topics: dict[str, Any],
    run_context: Context | None = None,
    **options: Any,  # noqa: ANN401
) -> dict[str, list[Any]]:
    config = McapSourceConfig(path=path, topics=topics, **options)
    return await run_operator(McapSource(config), config=config, run_context=run_context)


async def test_a_topic_beside_the_images_describes_their_camera(tmp_path: Path) -> None:
    encoded = EncodedImage(stamp_ns=1000, data=np.zeros(9, np.uint8), format="png", frame="right")
    with McapWriter(tmp_path / "drive.mcap") as writer:
        writer.write("/left/camera_info", _camera(1.0, "odd"), 5)
        writer.write("/right/camera_info", _camera(2.0), 5)
        writer.write("/left/image", _frame())
        writer.write("/right/image/compressed", encoded)
        writer.write("/elsewhere/image", _frame())
        writer.write("/nowhere/image", _frame(frame="unknown"))

    topics = {
        "frames": "/left/image",
        "images": "/right/image/compressed",
        "frames_by_frame": "/elsewhere/image",
        "frames_given": {"topic": "/elsewhere/image", "calibration": "/left/camera_info"},
        "frames_alone": "/nowhere/image",
    }
    out = await _played(tmp_path / "drive.mcap", topics)

    assert _focal_px(out["frames"][0]) == 1.0
    assert _focal_px(out["images"][0]) == 2.0
    assert _focal_px(out["frames_by_frame"][0]) == 2.0
    assert _focal_px(out["frames_given"][0]) == 1.0
    with pytest.raises(OperatorError, match="the camera unknown has no calibration"):
        require_camera(out["frames_alone"][0])
    topic = {"topic": "/left/image", "calibration": "/right/odd"}
    with pytest.raises(RecordingError, match="no topic /right/odd"):
        await _played(tmp_path / "drive.mcap", {"frames": topic})


async def test_images_that_seem_rectified_with_a_calibration_of_the_lens_are_named(
    tmp_path: Path,
) -> None:
    with McapWriter(tmp_path / "drive.mcap") as writer:
        writer.write("/left/camera_info", _camera(1.0), 5)
        writer.write("/left/image_rect", _frame())
    run_context = Context()

    await _played(tmp_path / "drive.mcap", {"frames": "/left/image_rect"}, run_context)

    (warning,) = run_context.activity.warnings
    assert "/left/image_rect seems to be rectified, but its calibration has a distortion" in warning


async def test_the_calibration_of_a_real_car() -> None:
    config = {"images": "/camera/image/compressed"}

    out = await _played(
        shared("kitti_camera_lidar") / "kitti_camera_lidar.mcap", config, end_s=0.05
    )

    assert _focal_px(out["images"][0]) == 721.5377


async def test_a_sensor_file_comes_before_topics_and_the_message_itself_before_both(
    tmp_path: Path,
) -> None:
    features = ImageFeatures(
        stamp_ns=1000, kind="brisk", frame="odd", keypoints_px=np.zeros((1, 2), np.float32)
    )
    with McapWriter(tmp_path / "drive.mcap") as writer:
        attach_rig(writer, _rig(3.0))
        writer.write("/left/camera_info", _camera(1.0), 5)
        writer.write("/left/image", _frame())
        writer.write("/left/features", features)
        writer.write("/left/undistorted", replace(_frame(), camera=_camera(4.0)))

    topics = {
        "frames": "/left/image",
        "frames_undistorted": "/left/undistorted",
        "features": {"topic": "/left/features", "type": "ImageFeatures"},
    }
    out = await _played(tmp_path / "drive.mcap", topics)

    assert _focal_px(out["frames"][0]) == 3.0
    assert _focal_px(out["frames_undistorted"][0]) == 4.0
    assert (out["features"][0].frame, _focal_px(out["features"][0])) == ("cam", 3.0)


async def test_images_of_another_size_go_unless_they_are_known_to_be_reduced(
    tmp_path: Path,
) -> None:
    with McapWriter(tmp_path / "drive.mcap") as writer:
        writer.write("/left/camera_info", _camera(10.0), 5)
        writer.write("/left/image", _frame(1000))
        writer.write("/left/image", _frame(2000, _GRAY[::2, ::2]))
    dropping, rescaling = Context(), Context()

    topics = {"frames": "/left/image"}
    kept = await _played(tmp_path / "drive.mcap", topics, dropping)
    whole = await _played(tmp_path / "drive.mcap", topics, rescaling, on_wrong_size="rescale")

    assert [frame.stamp_ns for frame in kept["frames"]] == [1000]
    ((loss, count),) = dropping.activity.losses.items()
    assert "images of cam with 32 x 24 px, where the calibration is of 64 x 48 px" in loss
    assert count == 1
    assert [_focal_px(frame) for frame in whole["frames"]] == [10.0, 5.0]
    assert whole["frames"][1].camera.center_px.tolist() == [15.5, 11.5]
    assert not rescaling.activity.losses


async def test_black_images_are_named_and_counted(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "drive.mcap") as writer:
        for stamp_ns, image in enumerate((_GRAY, _GRAY // 90, _GRAY // 90), start=1000):
            writer.write("/left/image", _frame(stamp_ns, image))
    run_context = Context()

    out = await _played(tmp_path / "drive.mcap", {"frames": "/left/image"}, run_context)

    assert len(out["frames"]) == 3
    ((warning, count),) = run_context.activity.warnings.items()
    assert "/left/image: images that are black, first at log time 1001 ns" in warning
    assert count == 2


async def test_decoded_images_keep_their_calibration_and_are_looked_at_as_well() -> None:
    def encoded(stamp_ns: int, image: np.ndarray) -> EncodedImage:
        data = cv2.imencode(".png", image)[1]
        return EncodedImage(
            stamp_ns=stamp_ns, data=data, format="png", frame="cam", camera=_camera(10.0)
        )

    run_context = Context()
    images = [encoded(0, _GRAY), encoded(1, _GRAY[:10]), encoded(2, _GRAY // 90)]
    out = await run_operator(
        ImageDecode(ImageDecodeConfig()), run_context=run_context, images=images
    )

    assert [(frame.stamp_ns, _focal_px(frame)) for frame in out["frames"]] == [(0, 10.0), (2, 10.0)]
    assert list(run_context.activity.warnings) == ["images of cam that are black"]
    (loss,) = run_context.activity.losses
    assert loss.startswith("images of cam with 64 x 10 px, where the calibration is of 64 x 48")
