"""Rules on single values: numbers are finite, rotations rotate, covariances could be ones."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.columns import TextArray, columns_of
from mapstream.recordings.maps.findings import Finding, Rule, where
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray

_ROTATION_TOLERANCE = 1e-6  # poses that were composed thousands of times stay below it
_COVARIANCE_TOLERANCE = 1e-9  # relative: what inverting an information matrix leaves
_OPTIONAL_STATES = (
    ("vertices", "velocity_mps"),
    ("vertices", "gyro_bias_radps"),
    ("vertices", "accel_bias_mps2"),
    ("frames", "origin_lla"),
    ("landmarks", "quat_base_xyzw"),
)
_DESCRIPTOR_BYTES = {"uint8": 1, "float32": 4}
_QUALITIES = ["unknown", "bad", "good"]


def _is_finite(values: npt.NDArray[Any]) -> BoolArray:
    """Return per row whether all of its numbers are finite."""
    finite: BoolArray = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    return finite


def _is_unknown(values: npt.NDArray[Any]) -> BoolArray:
    """Return per row whether all of its numbers are NaN."""
    unknown: BoolArray = np.isnan(values).all(axis=tuple(range(1, values.ndim)))
    return unknown


def _transforms(map_: Map) -> Iterator[tuple[str, str, FloatArray]]:
    for table_name, table in map_.tables().items():
        for column in columns_of(type(table)):
            if column.shape == (4, 4):
                yield table_name, column.name, getattr(table, column.name)


def finite_transforms(map_: Map) -> Iterable[Finding]:
    """Every pose and every measured transform is finite."""
    for table, column, T in _transforms(map_):
        yield from where(~_is_finite(T), table, f"{column} is not finite")


def rigid_transforms(map_: Map) -> Iterable[Finding]:
    """Every transform is a rotation and a translation."""
    for table, column, T in _transforms(map_):
        finite = _is_finite(T)
        R = np.where(finite[:, None, None], T[:, :3, :3], np.eye(3))
        error = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0)
        broken = (error > _ROTATION_TOLERANCE) | (np.linalg.det(R) < 0)
        broken |= finite & (T[:, 3] != [0, 0, 0, 1]).any(axis=1)
        yield from where(broken, table, f"{column} is not a rotation and a translation")


def finite_states(map_: Map) -> Iterable[Finding]:
    """Velocities, biases and positions of landmarks are known as a whole, or not at all."""
    for table, column in _OPTIONAL_STATES:
        values = getattr(map_.tables()[table], column)
        broken = ~_is_finite(values) & ~_is_unknown(values)
        yield from where(broken, table, f"{column} is neither finite nor wholly unknown (NaN)")
    lost = ~_is_finite(map_.landmarks.p_base)
    yield from where(lost, "landmarks", "the position is not finite")


def quaternions_have_unit_length(map_: Map) -> Iterable[Finding]:
    """An orientation is a quaternion of length one."""
    quat = map_.landmarks.quat_base_xyzw
    length = np.linalg.norm(np.where(np.isfinite(quat), quat, 0.5), axis=1)
    broken = np.abs(length - 1) > _ROTATION_TOLERANCE
    yield from where(
        broken, "landmarks", lambda row: f"the quaternion has length {length[row]:.6g}, not 1"
    )


def origins_lie_on_the_earth(map_: Map) -> Iterable[Finding]:
    """The latitude and longitude of an outer frame's origin are some of the earth's."""
    lat, lon = np.nan_to_num(map_.frames.origin_lla[:, :2]).T
    broken = (np.abs(lat) > 90) | (np.abs(lon) > 180)
    yield from where(
        broken,
        "frames",
        lambda row: f"no place on earth: latitude {lat[row]}, longitude {lon[row]}",
    )


def finite_imu_samples(map_: Map) -> Iterable[Finding]:
    """IMU samples are finite."""
    broken = ~_is_finite(np.hstack([map_.imu.gyro_radps, map_.imu.accel_mps2]))
    yield from where(broken, "imu", "the sample is not finite")


def _covariances(map_: Map) -> Iterator[tuple[str, FloatArray, BoolArray]]:
    """Yield the table, its covariances with 0 for what is infinite, and where they are given."""
    for table, C in (("edges", map_.edges.covariance), ("landmarks", map_.landmarks.covariance)):
        size = C.shape[1]
        unmeasured = np.isposinf(C) & np.eye(size, dtype=bool)
        is_given = ~_is_unknown(C) | (table == "edges")
        yield table, np.where(unmeasured, 0.0, C), is_given


def finite_covariances(map_: Map) -> Iterable[Finding]:
    """Covariances are finite but for the diagonal, where infinity says that nothing was measured."""
    for table, C, is_given in _covariances(map_):
        broken = is_given & ~_is_finite(C)
        yield from where(broken, table, "the covariance is not finite")


def symmetric_covariances(map_: Map) -> Iterable[Finding]:
    """Covariances are symmetric."""
    for table, C, is_given in _covariances(map_):
        C = np.where((is_given & _is_finite(C))[:, None, None], C, 0.0)  # noqa: PLW2901
        scale = np.abs(C).max(axis=(1, 2), initial=0)
        asymmetry = np.abs(C - np.swapaxes(C, 1, 2)).max(axis=(1, 2), initial=0)
        broken = asymmetry > _COVARIANCE_TOLERANCE * scale
        yield from where(broken, table, "the covariance is not symmetric")


def positive_covariances(map_: Map) -> Iterable[Finding]:
    """No direction has a negative variance."""
    for table, C, is_given in _covariances(map_):
        usable = is_given & _is_finite(C)
        rows = np.flatnonzero(usable)
        values = np.linalg.eigvalsh((C[rows] + np.swapaxes(C[rows], 1, 2)) / 2)
        broken = np.zeros(len(C), dtype=bool)
        broken[rows] = values[:, 0] < -_COVARIANCE_TOLERANCE * np.abs(values).max(axis=1, initial=0)
        yield from where(broken, table, "the covariance has a negative variance")


def switches_between_zero_and_one(map_: Map) -> Iterable[Finding]:
    """A switch lies between 0 and 1."""
    s = map_.edges.switch
    broken = ~((s >= 0) & (s <= 1))
    yield from where(broken, "edges", lambda row: f"the switch is {s[row]}, not 0 to 1")


def switch_variances(map_: Map) -> Iterable[Finding]:
    """The variance of a switch is not negative."""
    broken = map_.edges.switch_variance < 0
    yield from where(broken, "edges", "the variance of the switch is negative")


def kinds_are_named(map_: Map) -> Iterable[Finding]:
    """Edges, landmarks and resources say their kind."""
    for table in ("edges", "landmarks", "resources"):
        kinds = map_.tables()[table].kind  # type: ignore[attr-defined]  # these three have kinds
        yield from where(kinds == "", table, "the kind is empty")


def qualities_are_known(map_: Map) -> Iterable[Finding]:
    """The quality of a landmark is one of three words."""
    quality = map_.landmarks.quality
    broken = ~np.isin(quality, _QUALITIES)
    yield from where(
        broken, "landmarks", lambda row: f"the quality is {quality[row]!r}, not of {_QUALITIES}"
    )


def observations_say_something(map_: Map) -> Iterable[Finding]:
    """An observation has a keypoint or a 3D point."""
    seen = map_.observations
    has_pixel = _is_finite(seen.keypoint_px)
    has_point = _is_finite(seen.p_sensor)
    yield from where(~(has_pixel | has_point), "observations", "neither a keypoint nor a 3D point")


def observations_have_an_uncertainty(map_: Map) -> Iterable[Finding]:
    """The standard deviation of an observation is positive."""
    sigma = map_.observations.sigma
    broken = ~((sigma > 0) & np.isfinite(sigma))
    yield from where(broken, "observations", lambda row: f"sigma is {sigma[row]}, not positive")


def feature_sets_are_whole(map_: Map) -> Iterable[Finding]:
    """A set holds descriptors of its width, and those that observations refer to are in it."""
    sets, seen = map_.feature_sets, map_.observations
    item_bytes = np.array([_DESCRIPTOR_BYTES.get(dtype, 0) for dtype in sets.dtype], dtype=np.int64)
    unknown = item_bytes == 0
    yield from where(
        unknown, "feature_sets", lambda row: f"descriptors of type {sets.dtype[row]!r}"
    )
    num_bytes = np.fromiter(map(len, sets.descriptors), dtype=np.int64, count=len(sets))
    row_bytes = item_bytes * sets.width
    broken = ~unknown & ((sets.width < 0) | (num_bytes % np.maximum(row_bytes, 1) != 0))
    broken |= (row_bytes == 0) & (num_bytes > 0)
    yield from where(broken, "feature_sets", "the descriptors are not a whole number of rows")
    has_set = seen.feature_set >= 0
    num_rows = np.append(num_bytes // np.maximum(row_bytes, 1), 0)[seen.feature_set]
    misses = has_set & ((seen.feature < 0) | (seen.feature >= num_rows))
    yield from where(misses, "observations", "its descriptor is not in its feature set")
    kinds = np.append(sets.kind, "")[seen.feature_set]
    yield from where(
        has_set & (kinds != seen.kind), "observations", "its feature set is of another kind"
    )


def projections_are_whole(map_: Map) -> Iterable[Finding]:
    """A projection has a use, and finite numbers, as many as it says."""
    table = map_.projections
    sizes = {"mean": table.num_inputs, "matrix": table.num_inputs * table.num_outputs}
    for name, size in sizes.items():
        blocks = getattr(table, name)
        broken = [
            len(data) != 4 * count or not np.isfinite(np.frombuffer(data, "<f4")).all()
            for data, count in zip(blocks, size.tolist(), strict=True)
        ]
        found = np.array(broken, dtype=bool)
        yield from where(found, "projections", f"its {name} is not finite, or of another size")
    unknown = ~np.isin(table.use.astype(str), ["compression", "index"])
    yield from where(unknown, "projections", lambda row: f"a projection for {table.use[row]!r}")


def detections_are_whole(map_: Map) -> Iterable[Finding]:
    """A detection has a box in an image, and whole points."""
    table = map_.detections
    is_box = np.isfinite(table.box_px).all(axis=1) & (table.image_px > 0).all(axis=1)
    is_box &= (table.box_px[:, 2:] >= table.box_px[:, :2]).all(axis=1)
    yield from where(np.asarray(~is_box), "detections", "its box is not one")
    cut = np.array([len(data) % 12 > 0 for data in table.points], dtype=bool)
    yield from where(cut, "detections", "its points are not whole")


def regions_are_whole(map_: Map) -> Iterable[Finding]:
    """A region has a name, and corners that are finite."""
    table = map_.regions
    yield from where(table.name == "", "regions", "it has no name")
    broken = [
        not data or len(data) % 24 > 0 or not np.isfinite(np.frombuffer(data, "<f8")).all()
        for data in table.outline
    ]
    found = np.array(broken, dtype=bool)
    yield from where(found, "regions", "its outline is not finite, or not whole")


def texts_are_json(map_: Map) -> Iterable[Finding]:
    """Sensor sets and parameters of the journal are JSON objects."""
    for table, texts in (
        ("missions", map_.missions.sensors),
        ("journal", map_.journal.parameters),
    ):
        yield from where(~_is_json_object(texts), table, "expected a JSON object")


def _is_json_object(texts: TextArray) -> BoolArray:
    valid = []
    for text in texts:
        try:
            valid.append(isinstance(json.loads(text), dict))
        except ValueError:
            valid.append(False)
    return np.array(valid, dtype=bool)


def resources_stay_in_the_folder(map_: Map) -> Iterable[Finding]:
    """A file of the map is named relative to its folder and lies in it."""
    table = map_.resources
    paths = [PurePosixPath(path) for path in table.path]
    is_inside = [bool(p.parts) and not p.is_absolute() and ".." not in p.parts for p in paths]
    broken = (table.topic == "") & ~np.array(is_inside, dtype=bool)
    yield from where(
        broken, "resources", lambda row: f"{table.path[row]!r} leaves the map's folder"
    )


VALUE_RULES: tuple[Rule, ...] = (
    finite_transforms,
    rigid_transforms,
    finite_states,
    quaternions_have_unit_length,
    origins_lie_on_the_earth,
    finite_imu_samples,
    finite_covariances,
    symmetric_covariances,
    positive_covariances,
    switches_between_zero_and_one,
    switch_variances,
    kinds_are_named,
    qualities_are_known,
    observations_say_something,
    observations_have_an_uncertainty,
    feature_sets_are_whole,
    projections_are_whole,
    detections_are_whole,
    regions_are_whole,
    texts_are_json,
    resources_stay_in_the_folder,
)
