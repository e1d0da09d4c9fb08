"""Odometry by registering clouds of any origin one after another: of depth images, thinned, or edges alone.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section IV-D (ICP on full clouds, on thinned ones, and
on edges); the edges: Choi, Trevor, Christensen: RGB-D Edge Detection and Edge-Based Registration, IROS 2013.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.odometry.gicp_odometry import GicpOdometry, GicpOdometryConfig
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, report_loss
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.sensors import LidarScan


class CloudOdometryConfig(OperatorConfig):
    """Options of `cloud_odometry`; the defaults are those of a room and a hand."""

    registration: str = "gicp"
    """How clouds are aligned: icp, plane, gicp, vgicp, or an installed registration."""
    registration_options: dict[str, Any] = Field(default_factory=dict)
    """Options of an installed registration."""
    voxel_size_m: PositiveFloat = 0.02
    """Of the clouds that are aligned: about the distance of neighbouring points."""
    search_distances_m: tuple[PositiveFloat, ...] = (0.3, 0.1)
    """How far apart matching points may lie, coarse to fine."""
    inlier_distance_m: PositiveFloat = 0.04
    """How far from the surface a point may lie to count as an inlier."""
    min_inlier_fraction: NonNegativeFloat = 0.6
    """With fewer inliers a step is not believed."""
    max_range_m: PositiveFloat = 10.0
    num_keyframes: PositiveInt = 5
    """So many keyframes make the local map."""
    keyframe_distance_m: PositiveFloat = 0.2
    keyframe_angle_deg: PositiveFloat = 10.0
    max_speed_mps: PositiveFloat = 3.0
    """A faster step is taken for a failure."""
    max_rate_radps: PositiveFloat = 4.0
    max_lost: PositiveInt = 10
    """After so many lost clouds the local map starts anew at the predicted pose."""

    def tracking(self) -> GicpOdometryConfig:
        """Return the same as options of `gicp_odometry`, which aligns scans as this one aligns clouds."""
        same = self.model_dump(exclude={"max_lost"})
        return GicpOdometryConfig(**same, min_range_m=0, deskew=False, max_lost_scans=self.max_lost)


@dataclass(frozen=True)
class Inputs:
    """Clouds in the base frame, see `depth_cloud` and `depth_edges`."""

    clouds: Receiver[PointCloud]


@dataclass(frozen=True)
class Outputs:
    """One per cloud; the odom frame is the base at the first of them."""

    odometry: Sender[Odometry]


class CloudOdometry(Operator[Inputs, Outputs]):
    """Track the robot against the clouds of its last keyframes, as `gicp_odometry` does with scans."""

    placement: ClassVar[Placement] = "process"  # small_gicp holds the GIL

    def __init__(self, config: CloudOdometryConfig) -> None:
        self._tracker = GicpOdometry(config.tracking())
        self._last_ns: int | None = None

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for cloud in inputs.clouds:
            if self._last_ns is not None and cloud.stamp_ns <= self._last_ns:
                report_loss("clouds whose stamp does not increase")
                continue
            await outputs.odometry.send(await offload(self.register, cloud))

    def register(self, cloud: PointCloud) -> Odometry:
        """Align one cloud to the local map."""
        self._last_ns = cloud.stamp_ns
        scan = LidarScan(stamp_ns=cloud.stamp_ns, points=cloud.points, record=cloud.record)
        return self._tracker.register(scan)[0]
