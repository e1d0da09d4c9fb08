"""Trajectory management: one pose per stamp that a measurement asks for, linked by every source of motion.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section III-C. Measurements that come late are
waited for in a window (queueing), and later still they split a stretch that went out (pose splicing):
the graph that results does not depend on the order in which measurements came.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter

import numpy as np

from mapstream.operators.odometry.continuous import Motion
from mapstream.operators.submaps.overlap import Tracks, tracks_of
from mapstream.operators.submaps.records import records_of
from mapstream.operators.trajectory.dead_reckoning import LEVELLING_NS, DeadReckoning
from mapstream.operators.trajectory.links import Links
from mapstream.operators.trajectory.weak_links import ALWAYS, without_superfluous
from mapstream.operators.trajectory.window import CommitWindow, Seen, View
from mapstream.streams.errors import EstimationError
from mapstream.streams.join import END
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.estimates import (
    Keyframe,
    Odometry,
    PointCloud,
    RelativePose,
    Splice,
    Submap,
)
from mapstream.streams.messages.sensors import ImuBatch


class TrajectoryBuilder:
    """The trajectory of one mission, which goes out in submaps.

    Whoever owns it feeds the sources, asks for poses at stamps, and says with `commit` how far the sources
    have been heard. Each pair of consecutive poses gets one edge of every source that measured all of the
    interval, and a bridge where there is none.
    """

    def __init__(
        self,
        links: Links,
        *,
        window_ns: int | None = 0,
        num_common_tracks: int = ALWAYS,
        keep_ns: int = 30_000_000_000,
    ) -> None:
        """Make a trajectory.

        Args:
            links: The sources of motion; whoever feeds them keeps them longer than `keep_ns`.
            window_ns: How late measurements are waited for; None: all is held until the end.
            num_common_tracks: Below that many, odometry joins two poses; see `weak_links`.
            keep_ns: How late a measurement may split a stretch that went out.
        """
        self.sensors = "{}"  # JSON: the sensor set with its calibration
        self.lost: Counter[str] = Counter()  # measurements that found no place, by reason
        self._links = links
        self._window = CommitWindow(window_ns)
        self._keep_ns = keep_ns
        self._num_common_tracks = num_common_tracks
        self._tracks: Tracks = frozenset()  # that the newest pose sees
        self._late: dict[int, list[Constraint]] = {}  # by stamp, not newer than the newest pose
        self._out: list[int] = []  # stamps of poses that went out, of the last while
        self._num_submaps = 0
        self._ahead_ns = -END  # the stamp up to which the IMU was integrated for predictions
        self._reckoning = DeadReckoning(links.sources, links.imu)

    def ask(self, stamp_ns: int) -> None:
        """Ask for a pose at a stamp; asking twice gives one pose."""
        self._at(stamp_ns)

    def see(self, seen: Seen) -> None:
        """Ask for a pose where a cloud or an n-frame was seen, which the keyframe then holds."""
        if self._out and seen.stamp_ns <= self._out[-1]:
            what = "clouds" if isinstance(seen, PointCloud) else "n-frames"
            self.lost[f"{what} that came after their time went out"] += 1
        else:
            self._window.see(seen)

    def add(self, constraint: Constraint) -> None:
        """Take a measurement in, and ask for the pose that it is on."""
        self._at(constraint.stamp_ns).append(constraint)

    def _at(self, stamp_ns: int) -> list[Constraint]:
        if self._out and stamp_ns <= self._out[-1]:
            return self._late.setdefault(stamp_ns, [])
        return self._window.ask(stamp_ns)

    def ready(self, known_ns: int) -> list[int]:
        """Return the stamps that may go out, in order.

        Args:
            known_ns: Everything was heard up to here; `END` at the end.
        """
        stamps_ns = self._window.waited(known_ns)
        begins = self._links.imu is not None and not self._out
        ahead_ns = LEVELLING_NS if begins else 0

        def is_open(stamp_ns: int) -> int:
            return not self._links.is_decided(stamp_ns + ahead_ns, known_ns)

        return stamps_ns[: bisect_left(stamps_ns, 1, key=is_open)]  # behind an open one all are

    def commit(self, known_ns: int, *, up_to_ns: int = END) -> Submap | None:
        """Put out what is ready, up to a stamp, and what came late; None if that is nothing.

        Raises:
            EstimationError: If nothing links two consecutive poses; it names the pair.
        """
        splices, late = self._split_what_is_out()
        last = self._out[-1:]
        repeated = [Keyframe(stamp_ns=s, odometry=self._reckoning.at(s)) for s in last]
        keyframes, constraints, edges = list(repeated), late, []
        for stamp_ns in self.ready(known_ns):
            if stamp_ns > up_to_ns:
                break
            measured, view = self._window.take(stamp_ns)
            if self._links.is_outside(stamp_ns):
                self.lost["measurements before or after all that is known of motion"] += 1
                continue
            reaching = self._reach(stamp_ns)
            keyframes.append(self._keyframe(stamp_ns, view))
            before, self._tracks = self._tracks, tracks_of(keyframes[-1].features)
            edges += without_superfluous(reaching, before, self._tracks, self._num_common_tracks)
            constraints += measured
        if len(keyframes) == len(repeated) and not splices and not late:
            return None
        return self._submap(keyframes, edges, constraints, splices)

    def predict(self, stamp_ns: int) -> Odometry:
        """Return where the robot is at a stamp that is not out yet.

        Raises:
            EstimationError: If no source of motion reaches so far.
        """
        if not self._out:
            raise EstimationError(f"nothing is known of {stamp_ns} ns: no pose went out yet")
        newest_ns = self._out[-1]
        for source in self._links.sources.values():
            if source.covers(newest_ns, stamp_ns):
                start, end = (source.state_at(s).T_odom_base for s in (newest_ns, stamp_ns))
                motion = Motion(start.inverse() @ end, np.zeros((6, 6)), is_measured=False)
                return self._reckoning.reached(newest_ns, stamp_ns, motion)
        if self._links.imu is None or not self._links.imu.measures(newest_ns, stamp_ns):
            reason = f"no source of motion reaches from the pose at {newest_ns} ns"
            raise EstimationError(f"nothing is known of {stamp_ns} ns: {reason}")
        if (
            newest_ns < self._ahead_ns < stamp_ns
        ):  # go on from there: integrating all again takes long
            newest_ns = self._ahead_ns
        self._ahead_ns = stamp_ns
        return self._reckoning.go_on(newest_ns, stamp_ns, None)

    def _reach(self, stamp_ns: int) -> list[RelativePose]:
        """Go on to a new pose; return the edges that lead to it."""
        edges: list[RelativePose] = []
        if self._out:
            edges, motion = self._links.edges(self._out[-1], stamp_ns)
            self._reckoning.go_on(self._out[-1], stamp_ns, motion)
        else:
            self._reckoning.begin(stamp_ns)
        self._out.append(stamp_ns)
        return edges

    def _keyframe(self, stamp_ns: int, view: View = (None, ())) -> Keyframe:
        cloud, features = view
        odometry = self._reckoning.at(stamp_ns)
        return Keyframe(
            stamp_ns=stamp_ns,
            odometry=odometry,
            cloud=cloud,
            records=records_of(cloud, features),
            features=features,
        )

    def _split_what_is_out(self) -> tuple[list[Splice], list[Constraint]]:
        """Return splices for late measurements, and those that are on a pose which exists."""
        splices, on_poses = [], []
        for stamp_ns, constraints in sorted(self._late.items()):
            at = bisect_left(self._out, stamp_ns)
            if self._out[at] == stamp_ns:
                on_poses += constraints
            elif stamp_ns < self._out[-1] - self._keep_ns:
                self.lost["measurements that came too late even to split what is out"] += 1
            elif at == 0 and self._links.is_outside(stamp_ns):
                self.lost["measurements before or after all that is known of motion"] += 1
            else:
                splices.append(self._splice(stamp_ns, at, constraints))
        self._late.clear()
        return splices, on_poses

    def _splice(self, stamp_ns: int, at: int, constraints: list[Constraint]) -> Splice:
        following = self._out[at]
        after, motion = self._links.edges(stamp_ns, following)
        before: list[RelativePose] = []
        if at:
            before, motion = self._links.edges(self._out[at - 1], stamp_ns)
            self._reckoning.go_on(self._out[at - 1], stamp_ns, motion)
        else:
            self._reckoning.go_back(stamp_ns, following, motion)
        insort(self._out, stamp_ns)
        keyframe = self._keyframe(stamp_ns)
        edges = (*before, *after)
        return Splice(keyframe=keyframe, edges=edges, constraints=tuple(constraints))

    def _submap(
        self,
        keyframes: list[Keyframe],
        edges: list[RelativePose],
        constraints: list[Constraint],
        splices: list[Splice],
    ) -> Submap:
        submap = Submap(
            mission_id=self._links.mission_id,
            index=self._num_submaps,
            keyframes=tuple(keyframes),
            edges=tuple(edges),
            constraints=tuple(constraints),
            imu=self._samples([*edges, *(e for splice in splices for e in splice.edges)]),
            splices=tuple(splices),
            sensors=self.sensors,
        )
        self._num_submaps += 1
        oldest_ns = self._out[-1] - self._keep_ns
        del self._out[: max(bisect_left(self._out, oldest_ns) - 1, 0)]
        self._reckoning.forget_before(self._out[0])
        return submap

    def _samples(self, edges: list[RelativePose]) -> ImuBatch | None:
        """Return the samples behind the edges of kind imu."""
        inertial = [edge for edge in edges if edge.kind == "imu"]
        if self._links.imu is None or not inertial:
            return None
        first_ns = min(edge.stamp_a_ns for edge in inertial)
        return self._links.imu.samples(first_ns, max(edge.stamp_b_ns for edge in inertial))
