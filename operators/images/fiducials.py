"""Fiducial markers (AprilTag, ArUco) as measurements: of the camera's place, or of the markers'.

All markers of known place in an image give one measurement of kind `absolute`, from all their corners.
Each of the others is a landmark of kind `pose`, which the map finds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapstream.operators.features.gray import gray
from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.marker_detection import Family, Marker, detect_markers
from mapstream.operators.images.marker_places import TagConfig, tags_of
from mapstream.operators.images.marker_poses import PointsPose, points_pose, square_poses
from mapstream.operators.operator import (
    Operator,
    OperatorConfig,
    OptionalPath,
    pipeline,
    warn,
)
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import symmetric
from mapstream.streams.messages.constraints import Constraint, LandmarkRef, OuterFrame
from mapstream.streams.messages.sensors import CameraFrame


class FiducialsConfig(OperatorConfig):
    """Options of `fiducials`."""

    family: Family = "tag36h11"
    size_m: PositiveFloat | None = None
    """Side of the black square of all markers that are not described; without it they are left out."""
    tags: tuple[TagConfig, ...] = ()
    """Markers whose size or place is known."""
    tags_file: OptionalPath = Field(
        default=None, description="the same, as YAML: tags: [{id, size_m, T_frame_tag}]"
    )
    frame: str = ""
    """Name of the frame in which the places are, which an optimizer finds; empty: the map's own."""
    sigma_px: PositiveFloat = Field(
        default=0.15, description="of a corner; larger where the corners fit worse"
    )
    least_side_px: NonNegativeFloat = Field(
        default=16.0, description="markers that are smaller in the image are left out"
    )
    most_error_px: PositiveFloat = Field(
        default=3.0, description="rms; what fits worse is no measurement, and is counted"
    )
    least_ambiguity: float = Field(
        default=2.0,
        ge=1.0,
        description="how much worse the second pose of a single marker must fit than the first",
    )
    is_switchable: bool = False
    """An optimizer may find that a measurement is false."""


@dataclass(frozen=True)
class Inputs:
    frames: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    """For each image at most one of kind `absolute`, and one of kind `landmark` for each other marker."""

    constraints: Sender[Constraint]


class Fiducials(Operator[Inputs, Outputs]):
    """Find markers in images, and measure by them."""

    placement = "thread"

    def __init__(self, config: FiducialsConfig) -> None:
        self._config = config
        self._tags = tags_of(config.tags, config.tags_file, config.size_m)
        self._outer = OuterFrame(name=config.frame) if config.frame else None

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async def send(found: tuple[int, list[Constraint]]) -> None:
            stamp_ns, constraints = found
            for constraint in constraints:
                await outputs.constraints.send(constraint)
            if not constraints:
                outputs.constraints.advance(stamp_ns)

        await pipeline(self._measured, inputs.frames, send)

    def _measured(self, frame: CameraFrame) -> tuple[int, list[Constraint]]:
        return frame.stamp_ns, self.measure(frame)

    def measure(self, frame: CameraFrame) -> list[Constraint]:
        """Return the measurements of one image; what was seen and is none is counted by its reason.

        Raises:
            OperatorError: If the camera has no calibration.
        """
        camera = require_camera(frame)
        seen = list(self._usable(frame, camera))
        known = [marker for marker in seen if marker.number in self._tags.places]
        found = [
            self._absolute(frame, camera, known) if known else None,
            *(self._landmark(frame, camera, marker) for marker in seen if marker not in known),
        ]
        return [constraint for constraint in found if constraint is not None]

    def _usable(self, frame: CameraFrame, camera: CameraCalibration) -> Iterator[Marker]:
        for marker in detect_markers(gray(frame), camera, self._config.family):
            if self._tags.size_of(marker.number) is None:
                warn(f"marker {marker.number} in {frame.frame}, whose size nobody said")
            elif marker.side_px < self._config.least_side_px:
                warn(f"markers in {frame.frame} too small to measure by")
            else:
                yield marker

    def _absolute(
        self, frame: CameraFrame, camera: CameraCalibration, known: list[Marker]
    ) -> Constraint | None:
        """Return where the camera was, from all corners of known place; each marker alone gives starts."""
        starts = [
            pose.T_camera_points @ self._tags.places[marker.number].inverse()
            for marker in known
            for pose in self._poses(camera, marker)
        ]
        points = np.concatenate([self._tags.corners_in_frame(m.number) for m in known])
        px = np.concatenate([marker.corners_px for marker in known])
        best = self._sure(frame, [points_pose(camera, points, px, start) for start in starts])
        if best is None:
            return None
        T_camera_frame = best.T_camera_points
        moved = T_camera_frame.adjoint()  # a motion of the frame, as one of the camera
        return Constraint(
            stamp_ns=frame.stamp_ns,
            kind="absolute",
            T_a_b=T_camera_frame.inverse(),
            covariance=symmetric(moved @ self._covariance(best) @ moved.T),
            T_base_sensor=frame.T_base_sensor,
            outer=self._outer,
            is_switchable=self._config.is_switchable,
            source=f"fiducials {frame.frame}",
        )

    def _landmark(
        self, frame: CameraFrame, camera: CameraCalibration, marker: Marker
    ) -> Constraint | None:
        """Return where a marker was, from the base."""
        best = self._sure(frame, self._poses(camera, marker))
        if best is None:
            return None
        name = f"{self._config.family}:{marker.number}"
        return Constraint(
            stamp_ns=frame.stamp_ns,
            kind="landmark",
            T_a_b=frame.T_base_sensor @ best.T_camera_points,
            covariance=symmetric(self._covariance(best)),
            landmark=LandmarkRef(name=name, kind="pose", label="fiducial"),
            is_switchable=self._config.is_switchable,
            source=f"fiducials {frame.frame}",
        )

    def _poses(self, camera: CameraCalibration, marker: Marker) -> list[PointsPose]:
        return square_poses(camera, self._tags.corners_of(marker.number), marker.corners_px)

    def _sure(self, frame: CameraFrame, poses: list[PointsPose]) -> PointsPose | None:
        """Return the best pose, if it fits and no other one does."""
        config = self._config
        best = min(poses, key=lambda pose: pose.rms_px, default=None)
        if best is None or best.rms_px > config.most_error_px:
            warn(f"markers in {frame.frame} that do not fit their size, place or calibration")
            return None
        limit_px = config.least_ambiguity * max(best.rms_px, config.sigma_px)
        if any(_is_other(best, pose) and pose.rms_px < limit_px for pose in poses):
            warn(f"markers in {frame.frame} that may be seen in two ways")
            return None
        return best

    def _covariance(self, pose: PointsPose) -> FloatArray:
        sigma_px = max(self._config.sigma_px, pose.rms_px)
        return pose.covariance * sigma_px**2


def _is_other(a: PointsPose, b: PointsPose) -> bool:
    """Return whether two poses are apart by more than a solver's rounding."""
    difference = (a.T_camera_points.inverse() @ b.T_camera_points).log()
    return bool(np.abs(difference).max() > 1e-3)
