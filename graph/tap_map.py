"""A stored map in Rerun: where each mission went, which loops hold, and the cloud of all keyframes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from mapstream.graph.tap_sinks import Sink
from mapstream.operators.maps.aggregate import AggregateConfig, aggregate_cloud
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.cameras import cameras_of
from mapstream.recordings.maps.records import record_rows, recorded
from mapstream.recordings.mesh_files import SurfaceMesh
from mapstream.streams.errors import DecodeError, MapError, RecordingError
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage

if TYPE_CHECKING:
    from mapstream.graph.views import Scene

_PATH = "map"
_VOXEL_SIZE_M = 0.2  # a voxel of the cloud is a pixel or less where one sees a whole map
_MAX_POINTS = 3_000_000  # of the cloud; a viewer with more of them is slow
_FLUSH_S = 60.0
_MAX_PICTURES = 500  # of one mission
_PICTURES_AT_ONCE = 20


def view_map(
    map_: Map,
    folder: Path | None,
    sink: Sink,
    *,
    voxel_size_m: float = _VOXEL_SIZE_M,
    mesh: SurfaceMesh | None = None,
) -> list[str]:
    """Draw a map, and return what is missing from the picture.

    Args:
        map_: The map.
        folder: Its folder, with the clouds of its keyframes; None: without clouds.
        sink: Where it is drawn.
        voxel_size_m: One point of the cloud is drawn per voxel; voxels of a large map are larger.
        mesh: Its surface, in the map frame.

    Raises:
        MapError: If no viewer answers, or the one that did takes nothing.
    """
    from mapstream.graph.blueprint_map import map_blueprint  # noqa: PLC0415  # imports rerun
    from mapstream.graph.views import Scene, view_of  # noqa: PLC0415
    from mapstream.graph.views.maps import cloud_entry  # noqa: PLC0415
    from mapstream.graph.views.meshes import mesh_entry  # noqa: PLC0415

    notes = []
    scene = Scene(path=_PATH)
    drawing = [*view_of(map_)(map_, scene)]
    if folder is not None:
        try:
            config = AggregateConfig(
                voxel_size_m=voxel_size_m, with_unanchored=True, max_voxels=_MAX_POINTS
            )
            drawing.append(cloud_entry(map_, aggregate_cloud(map_, folder, config), scene))
        except MapError as error:  # a map without clouds still has trajectories
            notes.append(f"rerun: the map is drawn without clouds: {error}")
    if mesh is not None:
        drawing.append(mesh_entry(mesh))
    end_s = time.monotonic() + sink.patience_s
    while not sink.try_open(map_blueprint(map_)):
        if time.monotonic() > end_s:
            raise MapError("rerun: no viewer answered; start one with `rerun`, or try save=FILE")
        time.sleep(0.2)
    sink.draw(_PATH, drawing, stamp_ns=map_.stamp_ns, sequence=0)
    for mission in range(len(map_.missions)):
        notes += _draw_pictures(map_, mission, sink, scene)
    if not sink.flush(_FLUSH_S):
        raise MapError(f"rerun: the viewer did not take the map within {_FLUSH_S:.0f} s")
    sink.close()
    return notes


def _draw_pictures(map_: Map, mission: int, sink: Sink, scene: Scene) -> list[str]:
    """Draw what a mission's cameras saw, where the recording is at hand, and the map over it; return what is missing."""
    from mapstream.graph.views import view_of  # noqa: PLC0415  # imports rerun
    from mapstream.graph.views.drive import picture_path  # noqa: PLC0415
    from mapstream.graph.views.objects import map_detections  # noqa: PLC0415
    from mapstream.graph.views.overlay import overlay_entries  # noqa: PLC0415

    cameras = cameras_of(map_, mission)
    rows = record_rows(map_, mission)
    rows = rows[:: max(1, len(rows) // _MAX_PICTURES)]
    try:
        for sequence, (row, message) in enumerate(recorded(map_, rows)):
            if not isinstance(message, CameraFrame | EncodedImage):
                continue
            path = picture_path(map_, mission, message.frame, map_.resources.topic[row])
            vertex = int(map_.resources.vertex[row])
            stamp_ns = int(map_.vertices.stamp_ns[vertex])
            drawing = [*view_of(message)(message, scene)]
            if camera := cameras.get(message.frame):
                drawing += overlay_entries(map_, camera, message.frame, vertex)
                drawing += map_detections(map_, message.frame, vertex, scene)
            sink.draw(path, drawing, stamp_ns=stamp_ns, sequence=sequence)
            if sequence % _PICTURES_AT_ONCE == 0 and not sink.flush(_FLUSH_S):
                raise MapError(f"rerun: the viewer did not take pictures within {_FLUSH_S:.0f} s")
    except (RecordingError, DecodeError) as error:
        return [f"rerun: the map is drawn without pictures: {error}"]
    return []
