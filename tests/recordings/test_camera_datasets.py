"""Data sets of cameras as MCAP: images as they are, depth in millimetres, calibrations attached."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapstream.recordings.attached_rig import rig_of
from mapstream.recordings.datasets.catalogue import convert
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import open_recording
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import unproject
from mapstream.streams.errors import ConfigError, RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.sensors import ImuSensor
from tests.data import shared
from tests.recordings import made_datasets


def decoded(path: Path, topic: str) -> list[Any]:
    with open_recording(path) as recording:
        decode = decoder_for(recording.topics[topic].channel)
        return [decode(message) for message in recording.messages([topic])]


def calibration(path: Path, frame: str) -> CameraCalibration:
    camera = rig_of(path).camera_of_frame(frame)
    assert camera is not None
    assert isinstance(camera.calibration, CameraCalibration)
    return camera.calibration


def place(path: Path, frame: str) -> SE3:
    rig = rig_of(path)
    return rig.T_base_sensor(frame, 0)


def depth_mm(message: Any) -> list[list[int]]:  # noqa: ANN401
    pixels = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels.tolist()  # type: ignore[no-any-return]  # of a list of lists


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    return made_datasets.kitti(tmp_path / "07")


@pytest.fixture
def tum(tmp_path: Path) -> Path:
    return made_datasets.tum(tmp_path)


def test_A24_kitti_stereo_is_rectified_cameras_with_their_baseline(
    kitti: Path, tmp_path: Path
) -> None:
    done = convert(f"kitti:{kitti}", tmp_path / "out.mcap")

    left, right = decoded(done.path, "/cam0/image"), decoded(done.path, "/cam1/image")
    assert [image.stamp_ns for image in left] == [100_000_000, 200_000_000]
    assert right[1].data.tobytes() == (kitti / "image_1" / "000001.png").read_bytes()
    camera = calibration(done.path, "cam1")
    assert (camera.width_px, camera.height_px, camera.distortion) == (8, 6, "none")
    assert (camera.focal_px.tolist(), camera.center_px.tolist()) == ([700, 700], [4, 3])
    np.testing.assert_allclose(place(done.path, "cam1").t, [0.5, 0, 0])
    np.testing.assert_allclose(decoded(done.path, "/truth")[1].T_odom_base.t, [0, 0, 2])


def test_A24_kitti_images_beside_scans_hang_on_the_lidar(kitti: Path, tmp_path: Path) -> None:
    (kitti / "velodyne").mkdir()
    for index in range(2):
        np.ones((1, 4), np.float32).tofile(kitti / "velodyne" / f"{index:06d}.bin")

    done = convert(f"kitti:{kitti}", tmp_path / "out.mcap")

    assert len(decoded(done.path, "/points")) == 2
    assert rig_of(done.path).base_frame == "velodyne"
    # the camera's z is the LiDAR's x, its -x the LiDAR's y; the right camera sits to the right of the left one
    np.testing.assert_allclose(place(done.path, "cam0").t, [0.3, 0, 0])
    np.testing.assert_allclose(place(done.path, "cam1").t, [0.3, -0.5, 0])
    np.testing.assert_allclose(decoded(done.path, "/truth")[1].T_odom_base.t, [2, 0, 0], atol=1e-12)


def test_kitti_folders_that_do_not_fit_together_are_refused(kitti: Path, tmp_path: Path) -> None:
    (kitti / "image_1" / "000001.png").unlink()
    with pytest.raises(RecordingError, match="found 2 of cam0, 1 of cam1"):
        convert(f"kitti:{kitti}", tmp_path / "out.mcap")
    (kitti / "image_0" / "000001.png").unlink()
    (kitti / "calib.txt").write_text("P0: 700 0 4 0 0 700 3 0 0 0 1 0\n")
    with pytest.raises(RecordingError, match=r"expected a line 'P1: \.\.\.' with a camera's proj"):
        convert(f"kitti:{kitti}", tmp_path / "out.mcap")
    (kitti / "calib.txt").unlink()
    with pytest.raises(RecordingError, match="expected the projections of the cameras"):
        convert(f"kitti:{kitti}", tmp_path / "out.mcap")


def test_A24_tum_folder_with_the_published_calibration(tum: Path, tmp_path: Path) -> None:
    done = convert(f"tum:{tum}", tmp_path / "out.mcap")

    (color,), (depth,) = decoded(done.path, "/color/image"), decoded(done.path, "/depth/image")
    assert (color.stamp_ns, depth.stamp_ns) == (1305031102175304000, 1305031102160407000)
    assert (color.frame, depth.frame) == ("camera", "camera")
    assert depth_mm(depth) == [[0, 1000, 13107], [2000, 0, 500]]
    assert decoded(done.path, "/truth")[0].T_odom_base.t.tolist() == [1, 2, 3]
    camera = calibration(done.path, "camera")
    assert (camera.focal_px.tolist(), camera.distortion) == ([517.3, 516.5], "radtan")
    assert done.notices == ("the calibration is the published one of Freiburg 1",)


def test_A24_tum_key_frames_take_the_stamps_of_their_poses(tum: Path, tmp_path: Path) -> None:
    """As CubeSLAM lays them out, with a settings file of ORB-SLAM."""
    for name, folder in (("rgb", "rgb"), ("depth", "depth")):
        (tum / f"{name}.txt").write_text(f"# t f\n0 {folder}/a.png\n1 {folder}/a.png\n")
    (tum / "truth_cam_poses.txt").write_text("10.5\t1 2 3 0 0 0 1\t\n11.5\t1 2 4 0 0 0 1\t\n")
    (tum / "TUM3.yaml").write_text(
        "%YAML:1.0\nCamera.fx: 535.4\nCamera.fy: 539.2\nCamera.cx: 320.1\nCamera.cy: 247.6\n"
        "Camera.k1: 0.0\n"
    )

    done = convert(f"tum:{tum}", tmp_path / "out.mcap")

    for topic in ("/color/image", "/depth/image", "/truth"):
        assert [m.stamp_ns for m in decoded(done.path, topic)] == [10_500_000_000, 11_500_000_000]
    camera = calibration(done.path, "camera")
    assert (camera.focal_px.tolist(), camera.distortion) == ([535.4, 539.2], "none")
    (tum / "truth_cam_poses.txt").write_text("10.5 1 2 3 0 0 0 1\n")
    with pytest.raises(RecordingError, match="expected a pose for each of 2 images, found 1"):
        convert(f"tum:{tum}", tmp_path / "out.mcap")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("rgb.txt", "# nothing\n", r"rgb\.txt: expected lines with a stamp and a file, found none"),
        ("rgb.txt", "when? rgb/a.png\n", r"rgb\.txt:1: expected a stamp and a file"),
        ("rgb.txt", "1 rgb/b.png\n", r"b\.png: cannot be read"),
        ("depth.txt", "1 rgb/a.png\n", "expected depth as 16 bits of one channel, found uint8"),
    ],
)
def test_damaged_tum_folders_are_refused(
    tum: Path, name: str, content: str, message: str, tmp_path: Path
) -> None:
    (tum / name).write_text(content)

    with pytest.raises(RecordingError, match=message):
        convert(f"tum:{tum}", tmp_path / "out.mcap")


def test_a_tum_folder_whose_camera_nobody_knows_is_refused(tum: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"expected a \*\.yaml with Camera\.fx"):
        convert(f"tum:{tum.rename(tmp_path / 'walk')}", tmp_path / "out.mcap")
    (tmp_path / "walk" / "cam.yaml").write_text("Camera.fx: 535.4\n")
    with pytest.raises(ConfigError, match="fy"):
        convert(f"tum:{tmp_path / 'walk'}", tmp_path / "out.mcap")


def test_A24_seven_scenes_has_two_cameras_and_the_poses_of_the_depth_camera(
    tmp_path: Path,
) -> None:
    scene = made_datasets.seven_scenes(tmp_path / "scene")

    done = convert(f"7scenes:{scene}", tmp_path / "out.mcap")

    (truth,) = decoded(done.path, "/truth")
    assert (truth.stamp_ns, truth.T_odom_base.t.tolist()) == (33_333_333, [1, 2, 3])
    assert depth_mm(decoded(done.path, "/depth/image")[0]) == [[0, 5000, 0], [10000, 1, 2500]]
    assert len(decoded(done.path, "/color/image")) == 2
    assert rig_of(done.path).base_frame == "depth"
    assert calibration(done.path, "depth").focal_px.tolist() == [585, 585]
    np.testing.assert_allclose(place(done.path, "color").t, [0.0254, 0, 0], atol=3e-3)  # an inch
    assert done.notices[1] == "1 frames have no pose: their tracking was lost"
    (scene / "frame-000001.pose.txt").write_text("1 2 3")
    with pytest.raises(RecordingError, match="expected a pose of 4 x 4 numbers"):
        convert(f"7scenes:{scene}", tmp_path / "out.mcap")


_EQVIO = """row_type,t_abs,t_rel,seq,frame_idx,landmark_id,gx,gy,gz,ax,ay,az,u_norm,v_norm,key,value
meta,,,,,,,,,,,,,,measurement_space,normalized
meta,,,,,,,,,,,,,,camera_fx,458.654
meta,,,,,,,,,,,,,,camera_fy,457.296
meta,,,,,,,,,,,,,,camera_cx,367.215
meta,,,,,,,,,,,,,,camera_cy,248.375
meta,,,,,,,,,,,,,,T_ci_tx,0.1
meta,,,,,,,,,,,,,,T_ci_ty,0.2
meta,,,,,,,,,,,,,,T_ci_tz,0.3
meta,,,,,,,,,,,,,,T_ci_qw,1
meta,,,,,,,,,,,,,,T_ci_qx,0
meta,,,,,,,,,,,,,,T_ci_qy,0
meta,,,,,,,,,,,,,,T_ci_qz,0
vision_feature,10.0000001,0,0,0,7,,,,,,,0.5,-0.25,,
vision_feature,10.0000001,0,0,0,9,,,,,,,0,0,,
imu,10.0000001,0,1,,,1,2,3,4,5,6,,,,
vision_feature,10.05,0.05,2,1,7,,,,,,,0.6,-0.25,,
"""


def test_tracks_of_eqvio_become_pixels_that_look_along_the_same_rays(tmp_path: Path) -> None:
    (tmp_path / "tracks.csv").write_text(_EQVIO)

    done = convert(f"eqvio:{tmp_path / 'tracks.csv'}", tmp_path / "out.mcap")

    first, second = decoded(done.path, "/cam0/features")
    assert (first.stamp_ns, second.stamp_ns) == (10_000_000_000, 10_050_000_000)
    assert (first.track_ids.tolist(), second.track_ids.tolist()) == ([7, 9], [7])
    rays = unproject(calibration(done.path, "cam0"), first.keypoints_px.astype(np.float64))
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], [[0.5, -0.25], [0.0, 0.0]], atol=1e-6)
    assert place(done.path, "cam0").t.tolist() == [0.1, 0.2, 0.3]
    (imu,) = decoded(done.path, "/imu")
    assert (imu.gyro_radps.tolist(), imu.accel_mps2.tolist()) == ([[1, 2, 3]], [[4, 5, 6]])
    assert isinstance(rig_of(done.path).select("imu"), ImuSensor)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("normalized", "pixels", "expected features with measurement_space normalized, found 'pix"),
        ("meta,,,,,,,,,,,,,,camera_fx,458.654\n", "", "expected rows of meta with the camera"),
        ("imu,10.0000001,0,1,,,1", "imu,10.0000001,0,1,,,x", r"tracks\.csv:16: expected a row"),
        ("vision_feature", "noise", "expected rows of imu and of vision_feature, found 1 and 0"),
    ],
)
def test_damaged_tracks_are_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "tracks.csv").write_text(_EQVIO.replace(old, new))

    with pytest.raises(RecordingError, match=message):
        convert(f"eqvio:{tmp_path / 'tracks.csv'}", tmp_path / "out.mcap")


def test_A24_real_kitti_stereo(tmp_path: Path) -> None:
    """The files of a sequence are there; its calibration has no names, its times are nominal."""
    done = convert(f"kitti:{shared('kitti_stereo')}", tmp_path / "out.mcap")

    assert len(decoded(done.path, "/cam1/image")) == 25
    np.testing.assert_allclose(place(done.path, "cam1").t, [0.53715, 0, 0], atol=1e-5)


def test_A24_real_tum_key_frames(tmp_path: Path) -> None:
    done = convert(f"tum:{shared('tum_fr3_cabinet_rgbd')}", tmp_path / "out.mcap")

    assert decoded(done.path, "/depth/image")[57].stamp_ns == 1341841317250600000
    assert [len(boxes) for boxes in decoded(done.path, "/color/objects")] == [1] * 58
    assert done.notices == ()


def test_real_tracks_of_the_installed_gtsam(tmp_path: Path) -> None:
    done = convert("eqvio", tmp_path / "out.mcap")

    features = decoded(done.path, "/cam0/features")
    assert (len(features), sum(map(len, features))) == (601, 13316)
    assert sum(len(batch.stamps_ns) for batch in decoded(done.path, "/imu")) == 6001
