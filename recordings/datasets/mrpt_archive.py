"""The objects in an MRPT rawlog that a planar robot needs.

A rawlog is a sequence of objects: the length of the class name with its highest bit set, the name, a version, the
content, and an end mark. Frames of observations and collections of actions hold further objects. An object of a
class that is not known here has no length, so that what follows it cannot be found: reading stops there.
Numbers are little-endian; stamps count 100 ns from 1601-01-01.
Source of the layout: docs.mrpt.org, "Rawlog format"; serialization of the classes in MRPT (BSD).
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, quat_xyzw_from_rotation

_EPOCH_100NS = 116_444_736_000_000_000  # 1970 in ticks since 1601
_END = 0x88
_NULL = "nullptr"
_MAX_BEAMS = 1_000_000
_MAX_SIDE = 6  # of a matrix
_CLASS = re.compile(rb"([\x83-\xc0])(C[A-Z0-9][A-Za-z0-9_]{2,60})")


@dataclass(frozen=True, slots=True)
class RangeScan:
    stamp_ns: int
    ranges_m: FloatArray  # (N,) nan where invalid
    aperture_rad: float
    is_counter_clockwise: bool
    max_range_m: float
    T_base_laser: SE3


@dataclass(frozen=True, slots=True)
class MotionStep:
    """A motion of the robot since the step before, or its pose in the frame of the odometry."""

    stamp_ns: int
    motion: FloatArray  # (3,) x, y, yaw
    is_absolute: bool = False


class _UnknownError(Exception):
    """An object of a class, or a version, that is not known here."""


@dataclass(slots=True)
class Archive:
    """The bytes of a rawlog, and how far they were read."""

    content: bytes
    at: int = 0
    scans: list[RangeScan] = field(default_factory=list)
    steps: list[MotionStep] = field(default_factory=list)
    readers: dict[str, Callable[[int], Any]] = field(init=False)  # by class; each takes a version

    def __post_init__(self) -> None:
        self.readers = {
            "CSensoryFrame": self._objects,
            "CActionCollection": self._objects,
            "CObservation2DRangeScan": self._scan,
            "CActionRobotMovement2D": self._action,
            "CObservationOdometry": self._odometry,
            "CPose2D": self._pose2,
            "CPose3D": self._pose3,
            "CMatrixD": self._matrix,
            "CMatrix": partial(self._matrix, code="f"),
        }

    def read(self) -> str:
        """Read objects to the end, or to the first that is not known here; return why it stopped, if it did."""
        try:
            while self.at < len(self.content):
                self._object()
        except (_UnknownError, struct.error, ValueError) as error:
            return (
                f"reading stopped at byte {self.at} of {len(self.content)}: {error}; "
                + self._unknown()
            )
        return ""

    def _unknown(self) -> str:
        """Say of which classes, not known here, there are names in the file."""
        names = [m for m in _CLASS.finditer(self.content) if m[1][0] & 0x7F == len(m[2])]
        counts = Counter(m[2].decode() for m in names)
        unread = [f"{num} {name}" for name, num in counts.items() if name not in self.readers]
        return f"classes that are not known here: {', '.join(unread) or 'none'}"

    def _object(self) -> Any:  # noqa: ANN401  # by class
        length = self._one("B")
        name = self._take(length & 0x7F).decode("ascii", errors="replace")
        if length & 0x80 and name == _NULL:
            return None
        if not length & 0x80 or name not in self.readers:
            raise _UnknownError(f"an object of class {name!r}")
        version = self._one("B")
        value = self.readers[name](version)
        if self._one("B") != _END:
            raise _UnknownError(f"{name} of version {version} does not end where it should")
        return value

    def _objects(self, _version: int) -> None:
        for _ in range(self._one("I")):
            self._object()

    def _scan(self, version: int) -> None:
        self._require("CObservation2DRangeScan", version, range(4, 8))
        aperture_rad, to_left, max_range_m = self._one("f"), self._one("?"), self._one("f")
        T_base_laser = self._object()
        if version < 6:
            self._object()  # the covariance of the place
        num = self._one("I")
        if num > _MAX_BEAMS:
            raise _UnknownError(f"a scan of {num} beams")
        ranges_m = np.frombuffer(self._take(4 * num), "<f4").astype(np.float64)
        is_valid = np.frombuffer(self._take(num), np.uint8) != 0
        self._one("f")  # standard deviation of a range
        stamp_ns = self._stamp_ns()
        self._one("f")  # width of a beam
        if version >= 5:
            self._take(self._one("I"))  # the sensor's label
            self._one("d")  # pitch within the scan
        if version >= 7 and self._one("?"):
            self._take(4 * num)  # intensities
        ranges_m = np.where(is_valid & (ranges_m < max_range_m), ranges_m, np.nan)
        scan = RangeScan(stamp_ns, ranges_m, aperture_rad, bool(to_left), max_range_m, T_base_laser)
        self.scans.append(scan)

    def _action(self, version: int) -> None:
        self._require("CActionRobotMovement2D", version, range(5, 8))
        if self._one("i") != 0:
            raise _UnknownError("a motion that is not of odometry")
        motion = self._object()
        self._take(4 + 6 * 4 + 4 + 6 * 4)  # models of its noise
        has_velocity = self._one("?")
        if version < 7 or has_velocity:
            self._take(8 if version < 7 else 24)  # two floats, later three doubles
        has_encoders = self._one("?")
        if version < 7 or has_encoders:
            self._take(8)
        if version >= 6:
            stamp_ns = self._stamp_ns()
        else:
            stamp_ns = self.scans[-1].stamp_ns if self.scans else 0
        self.steps.append(MotionStep(stamp_ns, motion))

    def _odometry(self, version: int) -> None:
        self._require("CObservationOdometry", version, range(3))
        motion = self._object()
        self._take(self._one("I"))  # the sensor's label
        self.steps.append(MotionStep(self._stamp_ns(), motion, is_absolute=True))
        if version == 1:
            self._take(1 + 8 + 1 + 8)  # encoders and velocities, there or not
        if version == 2:
            self._take(8 if self._one("?") else 0)
            self._take(24 if self._one("?") else 0)

    def _pose2(self, version: int) -> FloatArray:
        self._require("CPose2D", version, range(2))
        return np.array(self._many("3d" if version else "3f"))

    def _pose3(self, version: int) -> SE3:
        self._require("CPose3D", version, range(4))
        if version < 2:
            T = self._object()
            return SE3.from_quat_xyzw(quat_xyzw_from_rotation(T[:3, :3]), T[:3, 3])
        x, y, z, qw, qx, qy, qz = self._many("7d")
        return SE3.from_quat_xyzw([qx, qy, qz, qw], [x, y, z])

    def _matrix(self, version: int, code: str = "d") -> FloatArray:
        self._require("a matrix", version, range(1))
        rows, columns = self._many("2I")
        if max(rows, columns) > _MAX_SIDE:
            raise _UnknownError(f"a matrix of {rows} x {columns}")
        return np.array(self._many(f"{rows * columns}{code}")).reshape(rows, columns)

    def _require(self, name: str, version: int, known: range) -> None:
        if version not in known:
            wanted = f"{known[0]} to {known[-1]}"
            raise _UnknownError(f"{name} of version {version}; versions {wanted} are known")

    def _stamp_ns(self) -> int:
        ticks: int = self._one("Q")
        return (ticks - _EPOCH_100NS) * 100

    def _one(self, code: str) -> Any:  # noqa: ANN401  # by the code
        return self._many(code)[0]

    def _many(self, codes: str) -> tuple[Any, ...]:
        return struct.unpack("<" + codes, self._take(struct.calcsize("<" + codes)))

    def _take(self, num_bytes: int) -> bytes:
        taken = self.content[self.at : self.at + num_bytes]
        if len(taken) < num_bytes:
            raise _UnknownError(f"the file ends {num_bytes - len(taken)} bytes too early")
        self.at += num_bytes
        return taken
