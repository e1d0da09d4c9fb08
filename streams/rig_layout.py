"""The words of maplab 2.0's sensor files, and what they are called here."""

from __future__ import annotations

import numpy as np

from mapstream.streams.calibration import CameraModel, Distortion
from mapstream.streams.sensors import SensorKind

KINDS: dict[str, SensorKind] = {
    "IMU": "imu",
    "LIDAR": "lidar",
    "NCAMERA": "ncamera",
    "CAMERA": "camera",
    "ODOMETRY_6DOF": "odometry",
    "WHEEL_ODOMETRY": "wheel",
    "ABSOLUTE_6DOF": "absolute",
    "GPS_UTM": "gps_utm",
    "GPS_WGS": "gps_wgs",
    "LOOP_CLOSURE": "loop_closure",
    "POINTCLOUD_MAP": "pointcloud_map",
    "EXTERNAL_FEATURES": "external_features",
}
COVARIANCE_KEYS: dict[SensorKind, str] = {
    "odometry": "T_St_Stp1_fixed_covariance",
    "wheel": "T_St_Stp1_fixed_covariance",
    "absolute": "T_G_S_fixed_covariance",
    "loop_closure": "T_A_B_fixed_covariance",
    "ncamera": "T_G_B_fixed_covariance",
}
NOISE_KEYS = {
    "gyro_density": "gyro_noise_density",
    "gyro_random_walk": "gyro_bias_random_walk_noise_density",
    "accel_density": "acc_noise_density",
    "accel_random_walk": "acc_bias_random_walk_noise_density",
}
LIMIT_KEYS = {
    "max_accel_mps2": "saturation_accel_max_mps2",
    "max_gyro_radps": "saturation_gyro_max_radps",
    "gravity_mps2": "gravity_magnitude_mps2",
}
MODELS: dict[str, CameraModel] = {"pinhole": "pinhole", "unified-projection": "unified"}
RANGE_IMAGE = "camera-3d-lidar"  # the type of a camera that is a LiDAR
DISTORTIONS: dict[str, Distortion] = {
    "none": "none",
    "radial-tangential": "radtan",
    "equidistant": "equidistant",
    "fisheye": "fov",
    "rational-polynomial": "rational_polynomial",
}
# of rows and columns of a covariance: translation first in the file, rotation first here
SWAP = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
