"""What one message adds to the picture, and what the picture remembers between messages.

A view returns entries whose paths are relative to the output that sent the message: `odometry/odometry`.
A path with a leading slash is absolute. What lies in the map needs no frame. What moves lies in a named
frame, so that a view need not know where the robot is: the map holds `odom` (moved by corrections),
`odom` holds `base` (moved by odometry), and `base` holds the sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from mapstream.streams.arrays import Float32Array, FloatArray, IntArray
from mapstream.streams.geometry import SE3

Vertex = tuple[str, int]  # mission, stamp
MAP, ODOM, BASE = (
    "tf#/",
    "odom",
    "base",
)  # the first is Rerun's name for the frame of plain entities
FRAMES = "/frames"  # the entities that hold the transforms between frames
_STRETCH = 100  # positions of a line that one message logs at most


@dataclass(frozen=True, slots=True)
class Entry:
    """Archetypes for one entity; static ones hold at every time."""

    path: str
    archetypes: tuple[Any, ...]  # of rerun
    is_static: bool = False

    @classmethod
    def of(cls, path: str, *archetypes: object, is_static: bool = False) -> Entry:
        return cls(path, archetypes, is_static)


@dataclass(frozen=True, slots=True)
class Columns:
    """Many values of one entity over time, logged in one call."""

    path: str
    stamps_ns: IntArray  # (N,)
    columns: rr.ComponentColumnList


Drawing = Iterable[Entry | Columns]
View = Callable[[Any, "Scene"], Drawing]


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewSettings:
    """How much detail is worth its bytes, and which output moves the robot."""

    max_points: int = 15_000  # of one scan or cloud
    max_submap_points: int = 10_000
    jpeg_above_bytes: int = 100_000  # raw images larger than this are compressed
    jpeg_quality: int = 80
    main_odometry: str | None = None  # path of the output that moves `base`; None: the first


@dataclass(slots=True)
class Scene:
    """What was drawn so far; one per recording, used by one thread."""

    settings: ViewSettings = field(default_factory=ViewSettings)
    path: str = ""  # of the output whose message is drawn now
    main_odometry: str | None = None
    T_map_odom: SE3 = field(default_factory=SE3.identity)
    missions: list[str] = field(default_factory=list)  # in the order of their appearance
    driven: dict[int, FloatArray] = field(default_factory=dict)  # stamp -> position in odom
    corrected: dict[str, tuple[IntArray, FloatArray]] = field(default_factory=dict)  # in map
    submaps: dict[str, tuple[Vertex, SE3]] = field(default_factory=dict)  # by path: what moves it
    loops: dict[tuple[Vertex, Vertex], float] = field(default_factory=dict)  # ends -> switch
    located: dict[str, tuple[int, SE3]] = field(default_factory=dict)
    """By output: how often the robot was recovered, and where it was last in the map."""
    tracked: dict[str, dict[str, tuple[int, IntArray, Float32Array]]] = field(default_factory=dict)
    """By kind and camera: stamp, track ids (N,) and places (N, 2) of the newest image."""
    _known: dict[tuple[str, str], Any] = field(default_factory=dict)
    _lines: dict[tuple[str, str], tuple[int, list[FloatArray]]] = field(default_factory=dict)

    def remember(self, key: str, value: Any) -> Any:  # noqa: ANN401  # views keep what they like
        """Return what this output remembered under the key first: this value, or an earlier one."""
        return self._known.setdefault((self.path, key), value)

    def once(self, key: str) -> bool:
        """Return True at the first call for this output and key: for styles, which are static."""
        token = object()
        return self.remember(key, token) is token

    def of_moment(self, key: str, stamp_ns: int, item: Any) -> list[Any]:  # noqa: ANN401  # as `remember`
        """Return what this output told for a stamp so far, with this item; what it told before that is over."""
        slot = (self.path, key)
        known_ns, items = self._known.get(slot, (stamp_ns, []))
        items = [*(items if known_ns == stamp_ns else []), item]
        self._known[slot] = stamp_ns, items
        return items

    def within(self, path: str, frame: str, *archetypes: object) -> list[Entry]:
        """Return the entries of an entity whose coordinates are those of a named frame."""
        entry = Entry.of(path, *archetypes)
        if not self.once(f"frame of {path}"):
            return [entry]
        # Static, or the viewer would complain at times before the first message.
        return [Entry.of(path, rr.CoordinateFrame(frame), is_static=True), entry]

    def mount(self, frame: str, T_base_sensor: SE3) -> list[Entry]:
        """Return the entry that places a sensor on the robot, if it is new or was moved."""
        slot = (FRAMES, frame)
        known = self._known.get(slot)
        if known is not None and np.array_equal(known, T_base_sensor.matrix):
            return []
        self._known[slot] = T_base_sensor.matrix
        return [placed(sensor_frame(frame), BASE, T_base_sensor)]

    def is_main(self) -> bool:
        """Return whether the output that is drawn now moves the robot."""
        if self.main_odometry is None:
            self.main_odometry = self.settings.main_odometry or self.path
        return self.main_odometry == self.path

    def mission_number(self, mission_id: str) -> int:
        """Return 0, 1, 2 ... in the order in which missions appear; colours follow it."""
        if mission_id not in self.missions:
            self.missions.append(mission_id)
        return self.missions.index(mission_id)

    def line(self, name: str, position: FloatArray) -> tuple[str, Float32Array]:
        """Add a position (3,) to a line; return the path and the points (N, 3), float32, of its last stretch.

        Stretches are short, so that a long line is not logged whole with each message.
        """
        slot = (self.path, name)
        number, points = self._lines.get(slot, (0, []))
        if len(points) >= _STRETCH:
            number, points = number + 1, points[-1:]
        points = [*points, position]
        self._lines[slot] = number, points
        return f"{name}/{number}", np.array(points, dtype=np.float32)

    def start_epoch(self) -> list[Entry]:
        """Forget where the robot was; return the entries that wipe the lines of this output."""
        lines = [slot for slot in self._lines if slot[0] == self.path]
        for slot in lines:
            del self._lines[slot]
        if self.main_odometry == self.path:
            self.driven.clear()
        return [Entry.of(name, rr.Clear(recursive=True)) for _, name in lines]

    def places(self, stamps_ns: npt.ArrayLike, mission_id: str | None = None) -> FloatArray | None:
        """Return positions (N, 3) in the map at stamps (N,), as good as they are known now.

        Each stamp gets the nearest known pose: the mission's corrected ones, beyond them the driven ones.
        None where nothing is known yet.
        """
        mission_id = mission_id or (self.missions[-1] if self.missions else None)
        stamps, positions = self.corrected.get(
            mission_id or "", (np.empty(0, np.int64), np.empty((0, 3)))
        )
        driven = np.fromiter(self.driven, np.int64, len(self.driven))
        is_newer = driven > (stamps[-1] if len(stamps) else np.iinfo(np.int64).min)
        if is_newer.any():
            ahead = np.array(list(self.driven.values()))[is_newer]
            stamps = np.concatenate([stamps, driven[is_newer]])
            positions = np.concatenate([positions, self.T_map_odom @ ahead])
        if not len(stamps):
            return None
        query = np.asarray(stamps_ns, dtype=np.int64)
        right = np.clip(np.searchsorted(stamps, query), 0, len(stamps) - 1)
        left = np.maximum(right - 1, 0)
        return positions[np.where(query - stamps[left] < stamps[right] - query, left, right)]


def sensor_frame(frame: str) -> str:
    """Return the name of a sensor's coordinate frame, which must not meet ours."""
    return f"sensor:{frame}"


def transform(
    T_parent_child: SE3, parent_frame: str | None = None, child_frame: str | None = None
) -> rr.Transform3D:
    """Return Rerun's form of a transform, of an entity or between named frames."""
    return rr.Transform3D(
        translation=T_parent_child.t,
        mat3x3=T_parent_child.R,  # a quaternion takes longer to compute than all else here
        parent_frame=parent_frame,
        child_frame=child_frame,
    )


def placed(child: str, parent: str, T_parent_child: SE3) -> Entry:
    """Return the entry that says where a frame lies in its parent."""
    moved = transform(T_parent_child, parent_frame=parent, child_frame=child)
    return Entry.of(f"{FRAMES}/{rr.escape_entity_path_part(child)}", moved)
