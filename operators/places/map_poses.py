"""What every localisation says: where the robot is in the map, or that it is lost, and that it is back."""

from __future__ import annotations

from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose, Odometry


class MapPoses:
    """Poses one after another; the first after being lost is `recovered`."""

    def __init__(self) -> None:
        self.has_tracked = False
        self._was_tracking = False

    def next(
        self,
        odometry: tuple[int, SE3],
        T_map_odom: SE3 | None,
        covariance: FloatArray,
        num_inliers: int,
        verdict: str,
    ) -> MapPose:
        """Return the pose of a moment.

        Args:
            odometry: Its stamp, and T_odom_base.
            T_map_odom: None while the robot is lost.
            covariance: Of the pose in the map, (6, 6); without meaning while the robot is lost.
            num_inliers: Of what was compared with the map since the pose before.
            verdict: On that.
        """
        stamp_ns, T_odom_base = odometry
        is_back = T_map_odom is not None and self.has_tracked and not self._was_tracking
        self._was_tracking = T_map_odom is not None
        self.has_tracked |= self._was_tracking
        if T_map_odom is None:
            return MapPose(
                stamp_ns=stamp_ns, state="lost", num_inliers=num_inliers, verdict=verdict
            )
        return MapPose(
            stamp_ns=stamp_ns,
            state="recovered" if is_back else "tracking",
            T_map_base=T_map_odom @ T_odom_base,
            T_map_odom=T_map_odom,
            covariance=covariance,
            num_inliers=num_inliers,
            verdict=verdict,
        )


async def send_pose(pose: MapPose, poses: Sender[MapPose], odometry: Sender[Odometry]) -> None:
    """Send a pose, and the same as odometry in the map; a robot that is lost only says that time goes on."""
    await poses.send(pose)
    if pose.T_map_base is None:
        odometry.advance(pose.stamp_ns)
        return
    await odometry.send(Odometry(stamp_ns=pose.stamp_ns, T_odom_base=pose.T_map_base))
