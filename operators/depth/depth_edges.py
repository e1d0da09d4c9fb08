"""Edges in space, from depth images and from the pictures beside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat

from mapstream.operators.depth.occlusion import occluding_edges
from mapstream.operators.features.gray import gray
from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.depth import PixelRays, depth_m_of
from mapstream.operators.odometry.rgbd.edges import edges_of
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.streams.arrays import Float32Array
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.sync import anchored, nearest


class DepthEdgesConfig(OperatorConfig):
    """Options of `depth_edges`."""

    jump_m: PositiveFloat = 0.04
    """From the nearer to the farther side of an outline, at least; it also exceeds the noise of depth."""
    max_gap_px: NonNegativeInt = 100
    """Of unknown depth between the two sides."""
    min_depth_m: NonNegativeFloat = 0.3
    max_depth_m: PositiveFloat = 5.0
    max_apart_s: PositiveFloat = 0.02
    """So far an image may be from the depth."""


@dataclass(frozen=True)
class Inputs:
    """Depth images, and colour or gray images of the same camera, whose edges count as well where they are given."""

    depth: Receiver[CameraFrame]
    frames: Receiver[CameraFrame] | None = None


@dataclass(frozen=True)
class Outputs:
    """Points on edges, in the base frame, one cloud per depth image."""

    clouds: Sender[PointCloud]


class DepthEdges(Operator[Inputs, Outputs]):
    """Find the outlines of things, and, where images are given, the edges of what is painted on them.

    A point of an outline lies on the nearer side, which it belongs to; where the farther one ends depends on the
    place of the camera.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: DepthEdgesConfig) -> None:
        self._config = config
        self._rays = PixelRays()

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        if inputs.frames is None:
            async for depth in inputs.depth:
                await outputs.clouds.send(await offload(self.found, depth))
            return
        apart_ns = round(self._config.max_apart_s * 1e9)
        pairs = anchored(inputs.depth, nearest(inputs.frames, apart_ns))
        async for depth, frame in pairs:
            await outputs.clouds.send(await offload(self.found, depth, frame))
        if pairs.stats.unmatched:
            warn(pairs.explain())

    def found(self, depth: CameraFrame, frame: CameraFrame | None = None) -> PointCloud:
        """Return the points on edges.

        Raises:
            OperatorError: If the depth image has no calibration, or the image is not as large.
        """
        config, rays = self._config, self._rays.of(require_camera(depth))
        depth_m = depth_m_of(depth, least_m=config.min_depth_m, most_m=config.max_depth_m)
        outlines_m = occluding_edges(depth_m, jump_m=config.jump_m, max_gap_px=config.max_gap_px)
        is_edge = np.isfinite(outlines_m)
        points = [rays[is_edge] * outlines_m[is_edge, None]]
        if frame is not None:
            points.append(_painted(frame, depth_m, rays))
        in_base = depth.T_base_sensor @ np.concatenate(points).astype(np.float64)
        return PointCloud(
            stamp_ns=depth.stamp_ns, points=in_base.astype(np.float32), record=depth.record
        )


def _painted(frame: CameraFrame, depth_m: Float32Array, rays: Float32Array) -> Float32Array:
    """Return points (N, 3) on the edges of an image, in the camera's frame."""
    if frame.image.shape[:2] != depth_m.shape:
        raise OperatorError(
            f"images of {frame.frame} are {frame.image.shape[:2]}, their depth is {depth_m.shape}; "
            "put depth_registration before depth_edges"
        )
    return edges_of(gray(frame), depth_m, rays)[0].astype(np.float32)
