"""Where the sensors of a recording sat on the robot, by a rig's file and by its transform topics.

A sensor that no transform names is itself the base. One whose place is known, but not at the time of a
message, loses that message: a guess would bend the map.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from mapstream.recordings.decoding import decoder_for, message_type_of
from mapstream.recordings.recording import Recording
from mapstream.streams.errors import DecodeError, TransformError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import TransformBatch
from mapstream.streams.transforms import TransformTree


class Extrinsics:
    """Transforms from sensors to the base, static ones read at the start, moving ones when needed.

    What the rig's file says of a frame counts, whatever a topic says of it.
    """

    def __init__(
        self, recording: Recording, topics: Sequence[str], tree: TransformTree, base_frame: str
    ) -> None:
        self.notices: Counter[str] = Counter()
        self._recording = recording
        self._base_frame = base_frame
        self._tree = tree
        self._fixed = frozenset(f for f in self._tree.frames if self._tree.parent_of(f))
        self._cache: dict[str, SE3 | None] = {}  # of frames that do not move
        there = [
            topic
            for topic in topics
            if topic in recording.topics
            and message_type_of(recording.topics[topic].channel) is TransformBatch
        ]
        self._moving = [topic for topic in there if not topic.endswith("tf_static")]
        self._read([topic for topic in there if topic.endswith("tf_static")])

    def place(self, frame: str, stamp_ns: int) -> SE3 | None:
        """Return T_base_sensor at a time, or None for a sensor whose place nobody described.

        Raises:
            TransformError: If its place is known, but not at that time.
        """
        if frame not in self._cache:
            found = self._static_place(frame)
            if found is None and self._moving:
                self._read(self._moving)
                self._moving = []
            if found is None and self._knows(frame):
                return self._tree.look_up(self._base_frame, frame, stamp_ns)
            if found is None and self._tree.frames:
                self.notices[
                    f"no transform leads from {frame} to {self._base_frame}: one is the other"
                ] += 1
            self._cache[frame] = found
        return self._cache[frame]

    def _static_place(self, frame: str) -> SE3 | None:
        if frame == self._base_frame:
            return SE3.identity()
        try:  # no sample reaches so far back, so that only static transforms answer
            return self._tree.look_up(self._base_frame, frame, -(2**63))
        except TransformError:
            return None

    def _knows(self, frame: str) -> bool:
        def root(of: str) -> str:
            parent = self._tree.parent_of(of)
            return of if parent is None else root(parent)

        frames = self._tree.frames
        return (
            frame in frames and self._base_frame in frames and root(frame) == root(self._base_frame)
        )

    def _read(self, topics: list[str]) -> None:
        if not topics:
            return
        decoders = {topic: decoder_for(self._recording.topics[topic].channel) for topic in topics}
        for raw in self._recording.messages(topics):
            try:
                batch = decoders[raw.topic](raw)
            except DecodeError as error:
                self.notices[f"a transform cannot be decoded: {error}"] += 1
                continue
            if isinstance(batch, TransformBatch):
                self._add(batch)

    def _add(self, batch: TransformBatch) -> None:
        """Add transforms one by one, so that a bad one costs no other."""
        for i, (parent, child) in enumerate(zip(batch.parents, batch.children, strict=True)):
            if child in self._fixed:
                continue
            try:
                T_parent_child = SE3(batch.T_parent_child[i])
                if batch.is_static:
                    self._tree.add_static(parent, child, T_parent_child)
                else:
                    stamp_ns = int(batch.stamps_ns[i])
                    self._tree.add_sample(parent, child, stamp_ns, T_parent_child)
            except TransformError as error:
                self.notices[f"transforms: {error}"] += 1
