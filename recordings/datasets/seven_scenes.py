"""7-Scenes: colour and depth of a Kinect, with the poses that KinectFusion found.

    DIR/frame-NNNNNN.color.png (or .jpg), .depth.png, .pose.txt

Depth is of another camera than colour, not registered to it: in millimetres, 65535 where nothing was seen. The
poses are of the depth camera, which is the base here. The authors give no calibration but KinectFusion's depth
camera (585 px, centre 320 240). For colour there is the driver's focal length, 525 px, and a Kinect
that LIRIS calibrated; on RedKitchen, with the poses given, matches between frames 1/3 s apart then meet within 1.8 px
(median), and within 3.4 px if colour and depth are taken for one camera.
Frames bear no times: they are 1/30 s apart.
Source: Shotton et al., Scene Coordinate Regression Forests, CVPR 2013;
projet.liris.cnrs.fr/voir/activities-dataset/kinect-calibration.html
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.datasets.conversion import Notices, Progress, Topical
from mapstream.recordings.datasets.image_files import depth_of, image_of
from mapstream.recordings.maps.ids import derived_id
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3, quat_xyzw_from_rotation
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraSensor

COLOR, DEPTH, TRUTH = "/color/image", "/depth/image", "/truth"
_PERIOD_NS = 33_333_333
_INVALID = 65535
_SIZE_PX = (640, 480)
_CENTER_PX = np.array([320.0, 240.0])
_FOCAL_PX = {"depth": 585.0, "color": 525.0}
_T_COLOR_DEPTH = SE3(
    np.array(
        [
            [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03, -0.025558943],
            [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03, 0.000101096],
            [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01, 0.002031832],
            [0, 0, 0, 1],
        ]
    )
)


def convert_seven_scenes(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/color/image`, `/depth/image` in millimetres and `/truth`, and attach the sensor file."""
    depths = sorted(source.glob("frame-*.depth.png"))
    if not depths:
        raise RecordingError(f"{source}: expected frame-*.depth.png, found none")
    attach_rig(writer, _rig())
    num_without_pose = 0
    for index, depth in enumerate(depths):
        messages = list(_frame(depth))
        num_without_pose += all(topic != TRUTH for topic, _ in messages)
        for topic, message in messages:
            writer.write(topic, message)
        on_progress((index + 1) / len(depths))
    notices = ("stamps are nominal, 30 Hz; the calibration is approximate",)
    if not num_without_pose:
        return notices
    return (*notices, f"{num_without_pose} frames have no pose: their tracking was lost")


def _frame(depth: Path) -> Iterator[Topical]:
    name = depth.name.removesuffix(".depth.png")
    digits = name.removeprefix("frame-")
    if not digits.isdecimal():
        raise RecordingError(f"{depth}: expected a name like frame-000000.depth.png")
    stamp_ns = (int(digits) + 1) * _PERIOD_NS  # zero would mean: no stamp
    colors = [depth.with_name(f"{name}.color.{suffix}") for suffix in ("png", "jpg")]
    color = next((path for path in colors if path.is_file()), colors[0])
    yield COLOR, image_of(color, stamp_ns, "color")
    yield DEPTH, depth_of(depth, stamp_ns, "depth", units_per_m=1000, invalid=_INVALID)
    pose = depth.with_name(f"{name}.pose.txt")
    if pose.is_file():
        yield from _truth(pose, stamp_ns)


def _truth(path: Path, stamp_ns: int) -> Iterator[Topical]:
    """Yield a pose from the four rows of a file; none where tracking was lost, which is written as NaN."""
    try:
        rows = np.array(path.read_text(encoding="utf-8").split(), np.float64).reshape(4, 4)
        if not np.isfinite(rows).all():
            return
        quat_xyzw = quat_xyzw_from_rotation(rows[:3, :3])  # as printed, not quite orthogonal
        T_odom_base = SE3.from_quat_xyzw(quat_xyzw, rows[:3, 3])
    except ValueError as error:
        raise RecordingError(f"{path}: expected a pose of 4 x 4 numbers: {error}") from error
    yield TRUTH, Odometry(stamp_ns=stamp_ns, T_odom_base=T_odom_base)


def _rig() -> Rig:
    cameras = {name: _camera(name) for name in _FOCAL_PX}
    base = cameras["depth"].id
    places = [
        Extrinsics(sensor_id=base, base_sensor_id=base, T_base_sensor=SE3.identity()),
        Extrinsics(
            sensor_id=cameras["color"].id,
            base_sensor_id=base,
            T_base_sensor=_T_COLOR_DEPTH.inverse(),
        ),
    ]
    return Rig(list(cameras.values()), places)


def _camera(name: str) -> CameraSensor:
    calibration = CameraCalibration(
        frame=name,
        width_px=_SIZE_PX[0],
        height_px=_SIZE_PX[1],
        focal_px=np.full(2, _FOCAL_PX[name]),
        center_px=_CENTER_PX,
        distortion_parameters=np.empty(0),
    )
    return CameraSensor(
        id=derived_id("sensor", "7scenes", name).hex(),
        topic=f"/{name}/image",
        description=f"Kinect, {name}",
        frame=name,
        calibration=calibration,
    )
