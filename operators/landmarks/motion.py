"""Where a robot was a moment before or after its vertices: for sensors that see points at times of their own.

Between two vertices positions and turns are cubic, with the velocities and rates that the vertices have;
where these are not known, differences of the poses stand for them. Before the first and after the last vertex
of a mission the motion goes on as it was.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-A (the observer's pose is interpolated to the keypoint's time).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.landmarks.sensors import T_base_of_imu
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import hat, invert, so3_exp, so3_log


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The motion of all missions, each in a frame of its own that stands still."""

    mission: IntArray  # (V,)
    stamps_ns: IntArray  # (V,)
    poses: FloatArray  # (V, 4, 4)
    velocities: FloatArray  # (V, 3) in the frame of the poses [m/s]; NaN: unknown
    rates: FloatArray  # (V, 3) in the base frame [rad/s]; NaN: unknown

    @classmethod
    def of(cls, map_: Map) -> Motion:
        """Return the motion that a map's vertices have, with the rates that its IMU felt."""
        vertices = map_.vertices
        return cls(
            mission=vertices.mission,
            stamps_ns=vertices.stamp_ns,
            poses=vertices.T_mission_base,
            velocities=vertices.velocity_mps,
            rates=rates_at_vertices(map_),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Times near vertices."""

    T_vertex_moment: FloatArray  # (N, 4, 4) the base at that time, in the base at the vertex
    twists: FloatArray  # (N, 6) of the base there, in its own axes: [rad/s, m/s]


def moments(motion: Motion, vertices: IntArray, offsets_ns: IntArray) -> Moments:
    """Return where the base was some time after each of these vertices; at no time after, where the vertex is.

    Args:
        motion: Of all vertices.
        vertices: Rows (N,).
        offsets_ns: Shape (N,) [ns].
    """
    pairs, back = np.unique(np.stack([vertices, offsets_ns]), axis=1, return_inverse=True)
    spans = _Spans.around(motion, pairs[0], pairs[1])
    T, twists = spans.evaluated()
    T_vertex_moment = invert(motion.poses[pairs[0]]) @ T
    T_vertex_moment[pairs[1] == 0] = np.eye(4)
    return Moments(T_vertex_moment[back.ravel()], twists[back.ravel()])


@dataclass(frozen=True, slots=True, eq=False)
class _Spans:
    """Two vertices around each time, or beside it, and what share of the way between them has passed."""

    start: FloatArray  # (N, 4, 4)
    turn: FloatArray  # (N, 3) from the first to the second vertex [rad]
    way: FloatArray  # (N, 3) [m]
    span_s: FloatArray  # (N, 1)
    share: FloatArray  # (N, 1) negative before the first vertex, above one after the last
    velocities: tuple[FloatArray, FloatArray]  # (N, 3) at the ends
    rates: tuple[FloatArray, FloatArray]

    @classmethod
    def around(cls, motion: Motion, vertices: IntArray, offsets_ns: IntArray) -> _Spans:
        velocities, rates = _filled(motion)
        order = np.lexsort((motion.stamps_ns, motion.mission))
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        mission = motion.mission[order]
        is_last = np.append(mission[1:] != mission[:-1], True)
        is_first = np.append(True, is_last[:-1])
        at, wanted_ns = place[vertices], motion.stamps_ns[vertices] + offsets_ns
        stamps_ns = motion.stamps_ns[order]
        while True:  # a time far from its vertex lies between two others
            later = ~is_last[at] & (wanted_ns >= stamps_ns[np.minimum(at + 1, len(order) - 1)])
            earlier = ~is_first[at] & (wanted_ns < stamps_ns[at])
            if not (later | earlier).any():
                break
            at = at + later - earlier
        first = np.where(is_last[at] & ~is_first[at], at - 1, at)
        second = np.where(is_last[at], at, at + 1)
        a, b = order[first], order[second]
        span_s = (motion.stamps_ns[b] - motion.stamps_ns[a]) / 1e9
        alone = span_s == 0
        span_s = np.where(alone, 1.0, span_s)
        share = (wanted_ns - motion.stamps_ns[a]) / 1e9 / span_s
        R_a, R_b = motion.poses[a, :3, :3], motion.poses[b, :3, :3]
        return cls(
            start=motion.poses[a],
            turn=so3_log(np.swapaxes(R_a, 1, 2) @ R_b),
            way=motion.poses[b, :3, 3] - motion.poses[a, :3, 3],
            span_s=span_s[:, None],
            share=share[:, None],
            velocities=(velocities[a], velocities[b]),
            rates=(rates[a], rates[b]),
        )

    def evaluated(self) -> tuple[FloatArray, FloatArray]:
        """Return poses (N, 4, 4) and twists (N, 6)."""
        turn, turn_rate = self._cubic(self.turn, self.rates)
        way, velocity = self._cubic(self.way, self.velocities)
        T = np.tile(np.eye(4), (len(turn), 1, 1))
        T[:, :3, :3] = self.start[:, :3, :3] @ so3_exp(turn)
        T[:, :3, 3] = self.start[:, :3, 3] + way
        rate = (_right_jacobian(turn) @ turn_rate[:, :, None])[:, :, 0]
        inside = np.einsum("nji,nj->ni", T[:, :3, :3], velocity)
        return T, np.concatenate([rate, inside], axis=1)

    def _cubic(
        self, whole: FloatArray, ends: tuple[FloatArray, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the Hermite spline from 0 to `whole` and its derivative by time; straight outside."""
        u, h = np.clip(self.share, 0, 1), self.span_s
        m_a, m_b = h * ends[0], h * ends[1]
        value = (u - 1) ** 2 * u * m_a + u**2 * (3 - 2 * u) * whole + u**2 * (u - 1) * m_b
        slope = ((3 * u - 1) * (u - 1) * m_a + 6 * u * (1 - u) * whole + u * (3 * u - 2) * m_b) / h
        return value + (self.share - u) * h * slope, slope


def _right_jacobian(turn: FloatArray) -> FloatArray:
    """Return to second order how a turn (N, 3) changes with its vector: what a span's turn needs."""
    K = hat(turn)
    jacobian: FloatArray = np.eye(3) - K / 2 + K @ K / 6
    return jacobian


def _filled(motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Return velocities and rates (V, 3); what is not known comes from the poses before and after."""
    velocities, rates = motion.velocities.copy(), motion.rates.copy()
    lost = ~(np.isfinite(velocities) & np.isfinite(rates)).all(axis=1)
    for mission in np.unique(motion.mission[lost]).tolist():
        rows = np.flatnonzero(motion.mission == mission)
        rows = rows[np.argsort(motion.stamps_ns[rows], kind="stable")]
        R, p = motion.poses[rows, :3, :3], motion.poses[rows, :3, 3]
        steps_s = np.diff(motion.stamps_ns[rows])[:, None] / 1e9
        for values, steps in (
            (velocities, np.diff(p, axis=0)),
            (rates, so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:])),
        ):
            unknown = ~np.isfinite(values[rows]).all(axis=1)
            values[rows[unknown]] = _slopes(steps / np.maximum(steps_s, 1e-9), steps_s)[unknown]
    return velocities, rates


def _slopes(slopes: FloatArray, steps_s: FloatArray) -> FloatArray:
    """Return derivatives (N, 3) at the knots between mean slopes (N - 1, 3), exact for parabolas."""
    if not len(slopes):
        return np.zeros((1, 3))
    inner = (steps_s[1:] * slopes[:-1] + steps_s[:-1] * slopes[1:]) / (steps_s[1:] + steps_s[:-1])
    return np.concatenate([slopes[:1], inner, slopes[-1:]])


def rates_at_vertices(map_: Map) -> FloatArray:
    """Return the rates (V, 3) in the base frame [rad/s] that the IMU felt at vertices; NaN without one."""
    rates = np.full((len(map_.vertices), 3), np.nan)
    if not len(map_.imu):
        return rates
    edges, first = np.unique(map_.imu.edge, return_index=True)
    last = np.append(first[1:], len(map_.imu)) - 1
    for vertices, near in (
        (map_.edges.vertex_b[edges], np.stack([np.maximum(last - 1, first), last])),
        (map_.edges.vertex_a[edges], np.stack([first, np.minimum(first + 1, last)])),
    ):
        stamps_ns, gyro = map_.imu.stamp_ns[near], map_.imu.gyro_radps[near]
        span = np.maximum(stamps_ns[1] - stamps_ns[0], 1)
        share = np.clip((map_.vertices.stamp_ns[vertices] - stamps_ns[0]) / span, 0, 1)[:, None]
        rates[vertices] = (1 - share) * gyro[0] + share * gyro[1]
    rates -= np.nan_to_num(map_.vertices.gyro_bias_radps)
    for mission in range(len(map_.missions)):
        own = map_.vertices.mission == mission
        rates[own] = rates[own] @ T_base_of_imu(map_, mission)[:3, :3].T
    return rates
