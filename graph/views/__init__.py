"""How each type of message looks in Rerun.

A package adds the look of its own messages in its `pyproject.toml`, by the full name of their class:

    [project.entry-points."mapstream.views"]
    "my_package.messages.Detections" = "my_package.views:view_detections"

The function takes the message and the `Scene`, and returns `Entry` and `Columns`.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import cast

from mapstream.graph.metrics import Snapshot
from mapstream.graph.views.constraints import view_constraint
from mapstream.graph.views.grids import view_occupancy_grid
from mapstream.graph.views.images import (
    view_camera_frame,
    view_encoded_image,
)
from mapstream.graph.views.lidar import (
    view_laser_scan,
    view_lidar_scan,
    view_organized_cloud,
    view_point_cloud,
)
from mapstream.graph.views.localization import view_map_pose
from mapstream.graph.views.mapping import (
    view_keyframe,
    view_loop_report,
    view_map_correction,
    view_submap,
)
from mapstream.graph.views.maps import view_map
from mapstream.graph.views.motion import (
    view_gnss_fix,
    view_imu_batch,
    view_odometry,
    view_transforms,
    view_wheel_odometry,
)
from mapstream.graph.views.objects import view_object_detections
from mapstream.graph.views.planes import view_plane_segments
from mapstream.graph.views.run import operator_graph, view_snapshot
from mapstream.graph.views.scene import Columns, Entry, Scene, View, ViewSettings
from mapstream.graph.views.tracks import view_image_features, view_n_frame
from mapstream.graph.views.unknown import view_unknown
from mapstream.recordings.maps import Map
from mapstream.streams.messages import (
    constraints,
    estimates,
    grids,
    objects,
    planes,
    sensors,
    vision,
)

__all__ = [
    "GROUP",
    "Columns",
    "Entry",
    "Scene",
    "View",
    "ViewSettings",
    "operator_graph",
    "view_of",
]

GROUP = "mapstream.views"

_BUILT_IN: dict[type, View] = {
    sensors.LidarScan: view_lidar_scan,
    sensors.OrganizedCloud: view_organized_cloud,
    sensors.CameraFrame: view_camera_frame,
    sensors.EncodedImage: view_encoded_image,
    sensors.ImuBatch: view_imu_batch,
    sensors.LaserScan2D: view_laser_scan,
    sensors.GnssFix: view_gnss_fix,
    sensors.WheelOdometry: view_wheel_odometry,
    sensors.TransformBatch: view_transforms,
    constraints.Constraint: view_constraint,
    estimates.Odometry: view_odometry,
    estimates.PointCloud: view_point_cloud,
    estimates.Keyframe: view_keyframe,
    estimates.Submap: view_submap,
    estimates.LoopReport: view_loop_report,
    estimates.MapCorrection: view_map_correction,
    estimates.MapPose: view_map_pose,
    grids.OccupancyGrid: view_occupancy_grid,
    objects.ObjectDetections: view_object_detections,
    planes.PlaneSegments: view_plane_segments,
    vision.ImageFeatures: view_image_features,
    vision.NFrame: view_n_frame,
    Map: view_map,
    Snapshot: view_snapshot,
}


_found: dict[type, View] = {}  # by type of message: entry points are slow to search


def view_of(message: object) -> View:
    """Return the view of a message: a plugin's, else ours, else numbers and text."""
    message_type = type(message)
    if message_type not in _found:
        _found[message_type] = _find(message_type)
    return _found[message_type]


def _find(message_type: type) -> View:
    for cls in message_type.__mro__:
        for point in entry_points(group=GROUP, name=f"{cls.__module__}.{cls.__qualname__}"):
            return cast(View, point.load())
        if cls in _BUILT_IN:
            return _BUILT_IN[cls]
    return view_unknown
