"""What is refined of cameras, between the missions' descriptions of them and the variables of the problem."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from mapstream.operators.estimation.keys import Variable, key_of, variable_of
from mapstream.operators.estimation.vision.sightings import SensorState, intrinsics_of
from mapstream.operators.landmarks.sensors import all_cameras, sensors_of
from mapstream.recordings.maps.cameras import with_cameras
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3

_MOUNT_SIGMAS = np.repeat([0.1, 0.1], 3)  # [rad, m] of a place that was measured by hand
_FOCAL_SHARE = 0.1  # a lens is known to a tenth
_DISTORTION_SIGMA = 0.3
_TIME_SIGMA_S = 0.1


def insert_mounts(map_: Map, rows: IntArray, values: Any) -> None:  # noqa: ANN401  # gtsam's
    """Put the places of cameras into gtsam's values."""
    cameras = list(all_cameras(map_).values())
    for row in rows.tolist():
        values.insert(key_of("camera", row), gtsam.Pose3(cameras[row].T_base_sensor.matrix))


def insert_intrinsics(map_: Map, rows: IntArray, values: Any) -> None:  # noqa: ANN401
    """Put the intrinsics of cameras into gtsam's values."""
    cameras = list(all_cameras(map_).values())
    for row in rows.tolist():
        values.insert(key_of("intrinsics", row), intrinsics_of(cameras[row].calibration))


def insert_time_offsets(map_: Map, rows: IntArray, values: Any) -> None:  # noqa: ANN401, ARG001
    """Put the time offsets of cameras into gtsam's values: a map's observations contain what is known of them."""
    for row in rows.tolist():
        values.insert(key_of("time_offset", row), np.zeros(1))


def camera_priors(values: Any) -> dict[int, Any]:  # noqa: ANN401
    """Return weak priors by key on what is refined of cameras: it stays near where it is."""
    priors: dict[int, Any] = {}
    diagonal = gtsam.noiseModel.Diagonal.Sigmas
    for key in values.keys():  # noqa: SIM118  # gtsam's
        variable, _ = variable_of(key)
        if variable == "camera":
            priors[key] = gtsam.PriorFactorPose3(key, values.atPose3(key), diagonal(_MOUNT_SIGMAS))
        elif variable == "intrinsics":
            known = values.atVector(key)
            sigmas = np.full(len(known), _DISTORTION_SIGMA)
            sigmas[:4] = _FOCAL_SHARE * known[:2].mean()
            priors[key] = gtsam.PriorFactorVector(key, known, diagonal(sigmas))
        elif variable == "time_offset":
            priors[key] = gtsam.PriorFactorVector(key, values.atVector(key), diagonal(np.array([_TIME_SIGMA_S])))  # fmt: skip
    return priors


def with_refined_cameras(
    map_: Map,
    values: Any,  # noqa: ANN401
    rows: Mapping[Variable, IntArray],
    fix: Collection[str] = (),
) -> Map:
    """Return the map with cameras as gtsam's values have them.

    A time offset moves the times of what the camera saw.

    Args:
        map_: The map.
        values: Of what was refined.
        rows: Of cameras, by variable.
        fix: With `extrinsics_rotation` or `extrinsics_translation` that half keeps its numbers.
    """
    nothing = np.zeros(0, np.int64)
    mounts, intrinsics, late = (rows.get(name, nothing).tolist() for name in ("camera", "intrinsics", "time_offset"))  # fmt: skip
    for row, ((mission, name), camera) in enumerate(all_cameras(map_).items()):
        changed = camera
        if row in mounts:
            T = values.atPose3(key_of("camera", row)).matrix()
            before = camera.T_base_sensor
            R = before.R if "extrinsics_rotation" in fix else T[:3, :3]
            t = before.t if "extrinsics_translation" in fix else T[:3, 3]
            changed = replace(changed, T_base_sensor=SE3.from_rotation(R, t))
        if row in intrinsics:
            found = values.atVector(key_of("intrinsics", row))
            changed = replace(changed, calibration=_refined(camera.calibration, found))
        if changed is not camera:
            map_ = with_cameras(map_, mission, {name: changed})
        if row in late:
            late_s = float(values.atVector(key_of("time_offset", row))[0])
            map_ = later(map_, (mission, name), round(late_s * 1e9))
    return map_


def later(map_: Map, camera: tuple[int, str], late_ns: int) -> Map:
    """Return the map in which a camera, by mission and name, saw everything later."""
    observations = map_.observations
    sensors, at = sensors_of(map_, np.arange(len(observations)))
    own = np.isin(at, [n for n, sensor in enumerate(sensors) if sensor == camera])
    sets = map_.feature_sets
    of_camera = (sets.sensor == camera[1]) & (map_.vertices.mission[sets.vertex] == camera[0])
    return replace(
        map_,
        observations=replace(observations, offset_ns=observations.offset_ns + late_ns * own),
        feature_sets=replace(sets, offset_ns=sets.offset_ns + late_ns * of_camera),
    )


def _refined(camera: CameraCalibration, parameters: FloatArray) -> CameraCalibration:
    calibration = SensorState(np.eye(4), camera).with_intrinsics(parameters).calibration
    assert calibration is not None  # noqa: S101  # it was given one
    return calibration
