"""Which operators there are: those of mapstream by a table, those of other packages by entry points.

Nothing is imported before it is asked for, so a broken plugin is the problem of graphs that use it.
A package offers operators in its `pyproject.toml`:

    [project.entry-points."mapstream.operators"]
    my_filter = "my_package.my_filter:MyFilter"
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from mapstream.graph.problems import did_you_mean
from mapstream.operators.operator import Operator
from mapstream.streams.errors import ConfigError

GROUP = "mapstream.operators"
OperatorType = type[Operator[Any, Any]]

BUILT_IN = {
    "absolute_poses": "mapstream.operators.absolute.poses:AbsolutePoses",
    "clahe": "mapstream.operators.images.clahe:Clahe",
    "cloud_colors": "mapstream.operators.images.cloud_colors:CloudColors",
    "cloud_images": "mapstream.operators.depth.cloud_images:CloudImages",
    "cloud_odometry": "mapstream.operators.odometry.cloud_odometry:CloudOdometry",
    "cloud_sink": "mapstream.operators.sinks.cloud:CloudSink",
    "cloud_planes": "mapstream.operators.planes.cloud_planes:CloudPlanes",
    "compress_descriptors": "mapstream.operators.features.compress_descriptors:CompressDescriptors",
    "dense_visual_odometry": "mapstream.operators.odometry.dense.dense_visual_odometry:DenseVisualOdometry",
    "depth_cloud": "mapstream.operators.depth.depth_cloud:DepthCloud",
    "depth_edges": "mapstream.operators.depth.depth_edges:DepthEdges",
    "depth_registration": "mapstream.operators.images.depth_registration:DepthRegistration",
    "eight_bits": "mapstream.operators.images.eight_bits:EightBits",
    "external_detections": "mapstream.operators.objects.external_detections:ExternalDetections",
    "external_features": "mapstream.operators.features.external_features:ExternalFeatures",
    "external_loops": "mapstream.operators.submaps.external_loops:ExternalLoops",
    "feature_tracker": "mapstream.operators.tracking.feature_tracker:FeatureTracker",
    "features": "mapstream.operators.features.features:Features",
    "fiducials": "mapstream.operators.images.fiducials:Fiducials",
    "gicp_odometry": "mapstream.operators.odometry.gicp_odometry:GicpOdometry",
    "global_descriptors": "mapstream.operators.networks.global_descriptors:GlobalDescriptors",
    "gnss": "mapstream.operators.gnss.positions:Gnss",
    "gray": "mapstream.operators.images.gray:Gray",
    "grid_localization": "mapstream.operators.laser.grid_localization:GridLocalization",
    "grid_sink": "mapstream.operators.sinks.grid:GridSink",
    "image_decode": "mapstream.operators.decode.image:ImageDecode",
    "imu_biases": "mapstream.operators.imu.biases:ImuBiases",
    "keyframes": "mapstream.operators.submaps.keyframes:Keyframes",
    "keypoint_depth": "mapstream.operators.tracking.keypoint_depth:KeypointDepth",
    "kiss_odometry": "mapstream.operators.odometry.kiss_odometry:KissOdometry",
    "klt": "mapstream.operators.tracking.klt:Klt",
    "laser_lines": "mapstream.operators.laser.laser_lines:LaserLines",
    "lidar_image": "mapstream.operators.lidar.images.lidar_image:LidarImage",
    "lidar_inertial_odometry": "mapstream.operators.odometry.lidar_inertial.lidar_inertial_odometry:LidarInertialOdometry",
    "lidar_keypoints": "mapstream.operators.lidar.images.lidar_keypoints:LidarKeypoints",
    "laser_loops": "mapstream.operators.laser.laser_loops:LaserLoops",
    "laser_odometry": "mapstream.operators.laser.laser_odometry:LaserOdometry",
    "lidar_loops": "mapstream.operators.lidar.loops:LidarLoops",
    "lidar_places": "mapstream.operators.lidar.places.lidar_places:LidarPlaces",
    "lidar_tracks": "mapstream.operators.lidar.images.lidar_tracks:LidarTracks",
    "localize": "mapstream.operators.places.localize:Localize",
    "localize_lidar": "mapstream.operators.lidar.places.localize_lidar:LocalizeLidar",
    "localize_planes": "mapstream.operators.planes.localize_planes:LocalizePlanes",
    "loop_reports": "mapstream.operators.backend.loop_reports:LoopReports",
    "map_overlay": "mapstream.operators.images.map_overlay:MapOverlay",
    "map_steps": "mapstream.operators.maps.steps:MapSteps",
    "map_store": "mapstream.operators.sinks.map_store:MapStore",
    "mcap": "mapstream.operators.sources.mcap:McapSource",
    "mcap_sink": "mapstream.operators.sinks.mcap:McapSink",
    "mesh_sink": "mapstream.operators.sinks.mesh:MeshSink",
    "n_frames": "mapstream.operators.tracking.n_frames:NFrames",
    "network_tracker": "mapstream.operators.networks.network_tracker:NetworkTracker",
    "object_descriptors": "mapstream.operators.objects.object_descriptors:ObjectDescriptors",
    "object_detector": "mapstream.operators.objects.object_detector:ObjectDetector",
    "object_features": "mapstream.operators.objects.object_features:ObjectFeatures",
    "object_masks": "mapstream.operators.objects.masks.object_masks:ObjectMasks",
    "object_measurements": "mapstream.operators.objects.object_measurements:ObjectMeasurements",
    "object_tracker": "mapstream.operators.objects.tracking.object_tracker:ObjectTracker",
    "occupancy_grid": "mapstream.operators.laser.occupancy_grid:OccupancyGrids",
    "odometry_adapter": "mapstream.operators.odometry.odometry_adapter:OdometryAdapter",
    "odometry_file": "mapstream.operators.sources.odometry_file:OdometryFile",
    "odometry_guard": "mapstream.operators.odometry.odometry_guard:OdometryGuard",
    "optimizer": "mapstream.operators.backend.optimizer:Optimizer",
    "orb": "mapstream.operators.features.features:Orb",
    "plane_landmarks": "mapstream.operators.planes.plane_landmarks:PlaneLandmarks",
    "plane_segmentation": "mapstream.operators.planes.plane_segmentation:PlaneSegmentation",
    "rectify": "mapstream.operators.images.rectify:Rectify",
    "resize": "mapstream.operators.images.resize:Resize",
    "rgbd_odometry": "mapstream.operators.odometry.rgbd.rgbd_odometry:RgbdOdometry",
    "semantic_loops": "mapstream.operators.objects.loops.semantic_loops:SemanticLoops",
    "static_clouds": "mapstream.operators.objects.static_clouds:StaticClouds",
    "submap_builder": "mapstream.operators.submaps.submap_builder:SubmapBuilder",
    "superpoint": "mapstream.operators.networks.superpoint:SuperPoint",
    "track_filter": "mapstream.operators.tracking.track_filter:TrackFilter",
    "trajectory": "mapstream.operators.trajectory.trajectory:Trajectory",
    "trajectory_sink": "mapstream.operators.sinks.trajectory:TrajectorySink",
    "undistort": "mapstream.operators.images.undistort:Undistort",
    "visual_inertial_odometry": "mapstream.operators.odometry.visual_inertial.visual_inertial_odometry:VisualInertialOdometry",
    "visual_odometry": "mapstream.operators.odometry.visual.visual_odometry:VisualOdometry",
    "visual_loops": "mapstream.operators.places.visual_loops:VisualLoops",
    "xfeat": "mapstream.operators.networks.xfeat:XFeat",
}


class Catalogue:
    """Operators by name.

    Args:
        extra: Operators that only this catalogue knows, for tests and for programs with their own.
    """

    def __init__(self, extra: Mapping[str, OperatorType] | None = None) -> None:
        self._extra = dict(extra or {})

    @cached_property
    def _plugins(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=GROUP)}

    def names(self) -> list[str]:
        return sorted({*BUILT_IN, *self._plugins, *self._extra})

    def origin(self, name: str) -> str:
        """Return the package that an operator comes from."""
        if name in self._extra:
            return self._extra[name].__module__
        if name in BUILT_IN:
            return "mapstream"
        point = self._plugins[name]
        return point.dist.name if point.dist else point.value.partition(".")[0]

    def get(self, name: str) -> OperatorType:
        """Import an operator.

        Raises:
            ConfigError: If there is none of this name, or its package cannot be imported.
        """
        if name in self._extra:
            return self._extra[name]
        if name not in BUILT_IN and name not in self._plugins:
            raise ConfigError(f"no operator {name!r}{did_you_mean(name, self.names())}")
        try:
            if name in BUILT_IN:  # a package cannot replace one of ours
                module, _, attribute = BUILT_IN[name].partition(":")
                found = getattr(import_module(module), attribute)
            else:
                found = self._plugins[name].load()
        except Exception as error:  # whatever another package does when it is imported
            reason = f"{type(error).__name__}: {error}"
            raise ConfigError(
                f"operator {name!r} of {self.origin(name)} cannot be imported: {reason}"
            ) from error
        if not (isinstance(found, type) and issubclass(found, Operator)):
            raise ConfigError(
                f"operator {name!r} of {self.origin(name)} is {found!r}, not an Operator class"
            )
        return found
