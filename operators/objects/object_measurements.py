"""Recognised objects as measurements on the robot's poses: a sign seen twice closes a loop.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section IV (object plugins, door signs).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapstream.operators.along_odometry import AlongOdometry, AlongOdometryOptions
from mapstream.operators.objects.certainty import CertaintyOptions, center_sigmas_m, sizes_m
from mapstream.operators.objects.recognition import Gate, KnownObject, KnownObjects, SeenObject
from mapstream.operators.operator import DynamicPorts, Operator, Placement, Ports, warn
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.channel import Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, LandmarkRef
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import NO_TRACK

_LOST_M = 5.0  # way that counts for a step without odometry


class ObjectMeasurementsConfig(AlongOdometryOptions, CertaintyOptions):
    """Options of `object_measurements`: inputs are `odometry`, those under `inputs`, and `corrections`."""

    inputs: tuple[str, ...] = ("detections",)
    """Names of the inputs that get objects, one for each camera."""
    period_s: NonNegativeFloat = 1.0
    """Of each camera one message in so long is used; views that are alike err alike. 0: all are."""
    labels: tuple[str, ...] = ()
    """Classes that are measured; empty: all."""
    by_place: bool = True
    """Things without a text are known by class and place; false: only by their texts."""
    gate_m: PositiveFloat = 0.3
    """So far a thing may be from where it was a moment ago ..."""
    gate_per_m: NonNegativeFloat = 0.03
    """... and so much more after each metre of way; odometry drifts."""
    most_gate_m: PositiveFloat = 2.0
    ambiguity: float = Field(
        default=2.0,
        ge=1,
        description="the second nearest of its class must be so many times as far",
    )
    center_share: NonNegativeFloat = Field(
        default=0.1,
        description="uncertainty of a centre as a share of the thing's longer side: one sees a thing from one side",
    )
    rotation_sigma_rad: PositiveFloat = 0.1
    """Of the orientation of a thing, where its detector knows one."""
    prefix: str = "object"
    """Of the names of things without a text; robots whose maps become one have different ones."""
    is_switchable: bool = False
    """An optimizer may find that a measurement is false."""


@dataclass(frozen=True)
class Outputs:
    """One measurement of kind `landmark` for each object whose place is known and that is recognised or new."""

    constraints: Sender[Constraint]


class ObjectMeasurements(DynamicPorts, Operator[Ports, Outputs]):
    """Recognise objects by their texts, else by class and place, and measure the robot's pose by them.

    An object with an orientation is a landmark of kind `pose`, one without is a 3D point of kind `object`; what it was
    when it was seen first, it stays. Its text is the name of its landmark, in all maps.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: ObjectMeasurementsConfig) -> None:
        self._config = config
        gate = Gate(
            at_once_m=config.gate_m,
            per_m=config.gate_per_m,
            most_m=config.most_gate_m,
            ambiguity=config.ambiguity,
        )
        self.known = KnownObjects(gate, config.prefix)
        self._along = AlongOdometry(
            config, self.known, self.measure, lost_m=_LOST_M, what="objects"
        )

    @classmethod
    def ports_for(cls, config: ObjectMeasurementsConfig) -> tuple[dict[str, Any], dict[str, Any]]:
        return config.ports(ObjectDetections), {}

    async def run(self, inputs: Ports, outputs: Outputs) -> None:
        await self._along.run(inputs, outputs.constraints)

    def measure(
        self, detections: ObjectDetections, T_mission_base: FloatArray, path_m: float
    ) -> list[Constraint]:
        """Return what one camera's objects say, seen from a pose (4, 4) after so much way."""
        centers = detections.centers_m
        if centers is None:
            centers = np.full((len(detections), 3), np.nan, np.float32)
        rows = self._usable(detections, centers)
        T_base_objects = [_T_base_object(detections, centers, row) for row in rows]
        objects = [
            SeenObject(
                label=detections.labels[row],
                p_frame=T_mission_base[:3, :3] @ T.t + T_mission_base[:3, 3],
                text=detections.texts[row] if detections.texts else "",
                track=_track(detections, row),
                is_oriented=_is_oriented(detections, row),
            )
            for row, T in zip(rows, T_base_objects, strict=True)
        ]
        found = self.known.see(detections.stamp_ns, objects, T_mission_base, path_m)
        made = []
        for row, T, same in zip(rows, T_base_objects, found, strict=True):
            if not same:
                warn(f"{detections.labels[row]}: may be one of two, and measures neither")
            made += [self._constraint(detections, row, T, known) for known in same]
        return made

    def _usable(self, detections: ObjectDetections, centers: Float32Array) -> list[int]:
        """Return the rows that are measured."""
        config, rows = self._config, []
        for row, label in enumerate(detections.labels):
            if config.labels and label not in config.labels:
                continue
            if not config.by_place and not (detections.texts and detections.texts[row]):
                continue
            if np.isfinite(centers[row]).all():
                rows.append(row)
            else:
                warn(f"objects of {detections.frame} whose place in space is not known")
        return rows

    def _sigma_m(self, detections: ObjectDetections, row: int) -> float:
        """Return how sure a centre is along each axis, with what nobody sees of the thing."""
        hidden_m = self._config.center_share * sizes_m(detections)[row]
        return float(np.hypot(center_sigmas_m(detections, self._config)[row], hidden_m))

    def _constraint(
        self, detections: ObjectDetections, row: int, T_base_object: SE3, known: KnownObject
    ) -> Constraint:
        sigma_m = self._sigma_m(detections, row)
        is_turned = known.is_pose and _is_oriented(detections, row)
        sigma_rad = self._config.rotation_sigma_rad if is_turned else np.inf
        return Constraint(
            stamp_ns=detections.stamp_ns,
            kind="landmark",
            T_a_b=T_base_object,
            covariance=np.diag(np.square([sigma_rad] * 3 + [sigma_m] * 3)),
            landmark=LandmarkRef(
                name=known.name, kind="pose" if known.is_pose else "object", label=known.label
            ),
            payload=_payload(detections, row),
            is_switchable=self._config.is_switchable,
            source=f"object_measurements {detections.frame}",
        )


def _T_base_object(detections: ObjectDetections, centers: Float32Array, row: int) -> SE3:
    """Return where the object is; with the axes of the base where it has none of its own."""
    quats = detections.quats_camera_object_xyzw
    p_camera = centers[row].astype(np.float64)
    if quats is None or not _is_oriented(detections, row):
        return SE3.from_rotation(np.eye(3), detections.T_base_sensor @ p_camera)
    return detections.T_base_sensor @ SE3.from_quat_xyzw(quats[row], p_camera)


def _is_oriented(detections: ObjectDetections, row: int) -> bool:
    quats = detections.quats_camera_object_xyzw
    return quats is not None and bool(np.isfinite(quats[row]).all())


def _track(detections: ObjectDetections, row: int) -> tuple[str, int] | None:
    ids = detections.track_ids
    return None if ids is None or ids[row] == NO_TRACK else (detections.frame, int(ids[row]))


def _payload(detections: ObjectDetections, row: int) -> bytes:
    """Return what is known of an object besides its place, as its landmark keeps it."""
    known: dict[str, object] = {}
    if detections.extents_m is not None and np.isfinite(detections.extents_m[row]).all():
        known["extent_m"] = [round(float(side), 4) for side in detections.extents_m[row]]
    if detections.texts and detections.texts[row]:
        known["text"] = detections.texts[row]
    return json.dumps(known, sort_keys=True).encode() if known else b""
