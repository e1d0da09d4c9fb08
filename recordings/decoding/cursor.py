"""Reading ROS messages field by field, in the two encodings that there are.

`CdrCursor`: ROS 2, Common Data Representation, little-endian (DDS-XTypes 1.3, 7.4.1): fields are
aligned to their size, counted from behind the four bytes of the encapsulation.
`Ros1Cursor`: the same fields packed without gaps; headers begin with a sequence number.
Arrays come out as read-only numpy views on the message.
"""

from __future__ import annotations

from math import isfinite
from struct import Struct
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray

_U8: Final = Struct("<B")
_I8: Final = Struct("<b")
_U16: Final = Struct("<H")
_U32: Final = Struct("<I")
_I64: Final = Struct("<q")
_F32: Final = Struct("<f")
_F64: Final = Struct("<d")
_STAMP: Final = Struct("<II")
_MAX_TRAILING: Final = 7  # bytes of padding that writers leave behind the last field


class CdrCursor:
    """A position in a message of ROS 2."""

    __slots__ = ("data", "position")

    def __init__(self, data: memoryview) -> None:
        """Check the encapsulation.

        Raises:
            ValueError: If the bytes are no little-endian CDR.
        """
        if len(data) < 4 or data[0] != 0 or data[1] != 1:
            raise ValueError(
                f"expected little-endian CDR (0x0001), found {bytes(data[:2]).hex() or 'nothing'}"
            )
        self.data = data
        self.position = 4

    def _align(self, size: int) -> int:
        return 4 + ((self.position - 4 + size - 1) & -size)

    def _number(self, kind: Struct) -> Any:  # noqa: ANN401  # int or float, as the struct says
        start = self._align(kind.size)
        self.position = start + kind.size
        return kind.unpack_from(self.data, start)[0]

    def u8(self) -> int:
        return int(self._number(_U8))

    def i8(self) -> int:
        return int(self._number(_I8))

    def u16(self) -> int:
        return int(self._number(_U16))

    def u32(self) -> int:  # the commonest, and clouds have many
        start = self._align(4)
        self.position = start + 4
        return int(_U32.unpack_from(self.data, start)[0])

    def i64(self) -> int:
        return int(self._number(_I64))

    def f32(self) -> float:
        return float(self._number(_F32))

    def f64(self) -> float:
        return float(self._number(_F64))

    def text(self) -> str:
        size = self.u32()
        return str(self.raw(size)[: max(size - 1, 0)], "utf-8")  # without the zero at its end

    def raw(self, size: int) -> memoryview:
        """Return the next bytes.

        Raises:
            ValueError: If the message ends before them.
        """
        start, self.position = self.position, self.position + size
        if self.position > len(self.data):
            raise ValueError(f"it ends inside a field of {size} bytes at byte {start}")
        return self.data[start : self.position]

    def array(self, dtype: str, count: int) -> npt.NDArray[Any]:
        """Return a view on `count` numbers."""
        size = int(dtype[-1])
        if count:
            self.position = self._align(size)
        return np.frombuffer(self.raw(count * size), dtype)

    def sequence(self, dtype: str) -> npt.NDArray[Any]:
        """Return a view on numbers that their count precedes."""
        return self.array(dtype, self.u32())

    def stride(self, size: int, alignment: int) -> int:
        """Return how far apart structures of this size lie in a sequence."""
        return -(-size // alignment) * alignment

    def stamp_ns(self) -> int:
        start = self._align(4)
        self.position = start + 8
        seconds, nanoseconds = _STAMP.unpack_from(self.data, start)
        return int(seconds) * 10**9 + int(nanoseconds)

    def header(self) -> tuple[int, str]:
        """Return the stamp and the frame of a std_msgs/Header."""
        return self.stamp_ns(), self.text()

    def pose(self) -> FloatArray:
        """Read a geometry_msgs/Pose or Transform, translation and quaternion x y z w, as (4, 4).

        Plain numbers, because numpy takes ten times as long for one transform.

        Raises:
            ValueError: If the quaternion has no length, or a number is not finite.
        """
        tx, ty, tz, x, y, z, w = self.array("<f8", 7).tolist()
        square = x * x + y * y + z * z + w * w
        if not (square > 0 and isfinite(square + tx + ty + tz)):
            raise ValueError(f"not a pose: translation {[tx, ty, tz]}, quaternion {[x, y, z, w]}")
        s = 2 / square
        return np.array(
            [
                [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y), tx],
                [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x), ty],
                [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y), tz],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )

    @property
    def is_at_end(self) -> bool:
        """Return whether nothing follows."""
        return self.position == len(self.data)

    def end(self) -> None:
        """Check that the message ends here.

        Raises:
            ValueError: If more follows than padding.
        """
        left = len(self.data) - self.position
        if left > _MAX_TRAILING:
            raise ValueError(f"{left} bytes are left behind its last field")


class Ros1Cursor(CdrCursor):
    """A position in a message of ROS 1."""

    __slots__ = ()

    def __init__(self, data: memoryview) -> None:  # no encapsulation to check
        self.data = data
        self.position = 0

    def _align(self, size: int) -> int:  # noqa: ARG002  # packed
        return self.position

    def stride(self, size: int, alignment: int) -> int:  # noqa: ARG002
        return size

    def text(self) -> str:
        return str(self.raw(self.u32()), "utf-8")

    def header(self) -> tuple[int, str]:
        self.u32()  # sequence number
        return self.stamp_ns(), self.text()
