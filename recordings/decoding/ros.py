"""ROS messages of IMUs, lasers, satellites, odometry and transforms as messages of ours.

The definitions are those of sensor_msgs, nav_msgs, geometry_msgs and tf2_msgs, the same in ROS 1 and 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from mapstream.recordings.decoding.cursor import CdrCursor
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import (
    GnssFix,
    ImuBatch,
    LaserScan2D,
    TransformBatch,
    WheelOdometry,
)

_IMU_NUMBERS = 37  # orientation 4 + 9, gyro 3 + 9, accelerometer 3 + 9
_GYRO, _ACCEL = slice(13, 16), slice(25, 28)
_STAMP = slice(4, 12)  # of a message of ROS 2 [bytes]
_ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])  # ROS writes the translation first


def imu(cursor: CdrCursor) -> ImuBatch:
    """Read a sensor_msgs/Imu as a batch of one sample."""
    stamp_ns, frame = cursor.header()
    values = cursor.array("<f8", _IMU_NUMBERS)
    cursor.end()
    stamps_ns = np.array([stamp_ns])
    return ImuBatch(
        stamps_ns=stamps_ns,
        gyro_radps=values[None, _GYRO],
        accel_mps2=values[None, _ACCEL],
        frame=frame or "imu",
    )


def imu_batch(payloads: Sequence[memoryview]) -> ImuBatch:
    """Read many sensor_msgs/Imu of ROS 2 at once, for a tenth of the time.

    Raises:
        ValueError: If they are not of one length and frame, or not little-endian CDR.
    """
    size = len(payloads[0])
    if any(len(payload) != size for payload in payloads):
        raise ValueError("IMU messages of different lengths in one batch")
    cursor = CdrCursor(payloads[0])
    _, frame = cursor.header()
    cursor.array("<f8", _IMU_NUMBERS)
    cursor.end()
    start = cursor.position - 8 * _IMU_NUMBERS
    joined = b"".join(payloads)
    heads = np.frombuffer(joined, np.uint8).reshape(len(payloads), size)[:, :start]
    differs = heads != heads[0]
    differs[:, _STAMP] = False
    if differs.any():
        raise ValueError("IMU messages of different frames or encodings in one batch")
    rows = np.frombuffer(joined, _imu_rows(size, start))
    return ImuBatch(
        stamps_ns=rows["seconds"].astype(np.int64) * 10**9 + rows["nanoseconds"],
        gyro_radps=rows["gyro"],
        accel_mps2=rows["accel"],
        frame=frame or "imu",
    )


@cache
def _imu_rows(size: int, start: int) -> np.dtype[np.void]:
    """Return the layout of an Imu message whose numbers begin at a byte."""
    return np.dtype(
        {
            "names": ["seconds", "nanoseconds", "gyro", "accel"],
            "formats": ["<u4", "<u4", ("<f8", 3), ("<f8", 3)],
            "offsets": [4, 8, start + 8 * _GYRO.start, start + 8 * _ACCEL.start],
            "itemsize": size,
        }
    )


def laser_scan(cursor: CdrCursor) -> LaserScan2D:
    """Read a sensor_msgs/LaserScan; what is out of range becomes nan."""
    stamp_ns, frame = cursor.header()
    angle_min, _, angle_step, beam_period_s, _, range_min, range_max = cursor.array(
        "<f4", 7
    ).tolist()
    ranges, intensity = cursor.sequence("<f4"), cursor.sequence("<f4")
    cursor.end()
    with np.errstate(invalid="ignore"):
        is_seen = (ranges >= range_min) & (ranges <= range_max)
    return LaserScan2D(
        stamp_ns=stamp_ns,
        ranges_m=np.where(is_seen, ranges, np.float32(np.nan)),
        angle_min_rad=angle_min,
        angle_step_rad=angle_step,
        range_min_m=range_min,
        range_max_m=range_max,
        beam_period_ns=round(beam_period_s * 1e9),
        intensity=intensity if len(intensity) == len(ranges) else None,
        frame=frame or "laser",
    )


def nav_sat_fix(cursor: CdrCursor) -> GnssFix:
    """Read a sensor_msgs/NavSatFix.

    Raises:
        ValueError: If the receiver says that it has no fix.
    """
    stamp_ns, frame = cursor.header()
    status, _ = cursor.i8(), cursor.u16()
    latitude, longitude, altitude = cursor.array("<f8", 3).tolist()
    covariance, kind = cursor.array("<f8", 9), cursor.u8()
    cursor.end()
    if status < 0:
        raise ValueError(f"the receiver has no fix (status {status})")
    return GnssFix(
        stamp_ns=stamp_ns,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=altitude,
        covariance_enu_m2=covariance.reshape(3, 3) if kind else None,
        frame=frame or "gnss",
    )


def odometry(cursor: CdrCursor) -> Odometry:
    """Read a nav_msgs/Odometry; its covariance is of the pose, not of a step, and is left out.

    The twist is taken as the convention has it, in the frame of the body. One of zeros with a covariance of
    zeros was never filled in (FAST-LIO2 does so), and is no velocity.
    """
    stamp_ns, pose, _, velocity_mps = _ros_odometry(cursor)
    cursor.end()
    return Odometry(stamp_ns=stamp_ns, T_odom_base=pose, velocity_mps=velocity_mps)


def odometry_with_biases(cursor: CdrCursor) -> Odometry:
    """Read a maplab_msgs/OdometryWithImuBiases: as nav_msgs/Odometry, the accelerometer's bias, the gyroscope's."""
    stamp_ns, pose, _, velocity_mps = _ros_odometry(cursor)
    accel_bias, gyro_bias = cursor.array("<f8", 3), cursor.array("<f8", 3)
    cursor.end()  # the state of the odometry, one number, is not read
    return Odometry(
        stamp_ns=stamp_ns,
        T_odom_base=pose,
        velocity_mps=velocity_mps,
        gyro_bias_radps=gyro_bias,
        accel_bias_mps2=accel_bias,
    )


def wheel_odometry(cursor: CdrCursor) -> WheelOdometry:
    """Read a nav_msgs/Odometry as that of wheels."""
    stamp_ns, pose, covariance, _ = _ros_odometry(cursor)
    cursor.end()
    return WheelOdometry(
        stamp_ns=stamp_ns, T_odom_base=pose, covariance=_rotation_first(covariance)
    )


def _ros_odometry(cursor: CdrCursor) -> tuple[int, SE3, FloatArray, FloatArray | None]:
    """Return the stamp, the pose, its covariance, and the velocity in the frame of the pose."""
    stamp_ns, _ = cursor.header()
    cursor.text()  # child frame
    pose, covariance = SE3(cursor.pose()), cursor.array("<f8", 36)
    twist, twist_covariance = cursor.array("<f8", 6), cursor.array("<f8", 36)
    is_known = twist.any() or twist_covariance.any()
    return stamp_ns, pose, covariance, pose.R @ twist[:3] if is_known else None


def _rotation_first(covariance: FloatArray) -> FloatArray | None:
    """Reorder to rotation first; all zeros mean that nobody knows."""
    if not covariance.any():
        return None
    reordered: FloatArray = covariance.reshape(6, 6)[np.ix_(_ROTATION_FIRST, _ROTATION_FIRST)]
    return reordered


def pose(cursor: CdrCursor) -> Odometry:
    """Read a geometry_msgs/PoseStamped."""
    stamp_ns, _ = cursor.header()
    T_odom_base = SE3(cursor.pose())
    cursor.end()
    return Odometry(stamp_ns=stamp_ns, T_odom_base=T_odom_base)


def pose_with_covariance(cursor: CdrCursor) -> Odometry:
    """Read a geometry_msgs/PoseWithCovarianceStamped; the covariance is left out as in `odometry`."""
    stamp_ns, _ = cursor.header()
    T_odom_base = SE3(cursor.pose())
    cursor.array("<f8", 36)
    cursor.end()
    return Odometry(stamp_ns=stamp_ns, T_odom_base=T_odom_base)


def transforms(cursor: CdrCursor, *, is_static: bool) -> TransformBatch:
    """Read a tf2_msgs/TFMessage."""
    stamps_ns, parents, children, matrices = [], [], [], []
    for _ in range(cursor.u32()):
        stamp_ns, parent = cursor.header()
        stamps_ns.append(stamp_ns)
        parents.append(parent.lstrip("/"))  # ROS 1 habit
        children.append(cursor.text().lstrip("/"))
        matrices.append(cursor.pose())
    cursor.end()
    return TransformBatch(
        stamps_ns=np.array(stamps_ns, np.int64),
        parents=tuple(parents),
        children=tuple(children),
        T_parent_child=np.array(matrices).reshape(-1, 4, 4),
        is_static=is_static,
    )
