"""A stored map with cameras: who saw its landmarks, the robot on its way, its states and its pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from mapstream.graph.tap_map import view_map
from mapstream.graph.tap_sinks import SinkSpec
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.maps.tables import Landmarks
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import EncodedImage, RecordRef
from mapstream.streams.messages.vision import ImageFeatures
from tests.graph.rrd import read_rrd, strict, values_of
from tests.recordings.made_maps import MISSION, submaps
from tests.recordings.test_map_features import CAMERA

ROBOT = f"/map/robots/{MISSION[:8]}"


def seen_map(recording: Path) -> Map:
    """A map of four keyframes, at each of which a camera saw three points that became landmarks."""
    [submap] = submaps([3])
    frames = []
    for keyframe in submap.keyframes:
        record = RecordRef(path=str(recording), topic="/cam0/image", log_ns=keyframe.stamp_ns)
        features = ImageFeatures(
            stamp_ns=keyframe.stamp_ns,
            kind="klt",
            frame="cam0",
            keypoints_px=np.full((3, 2), 5.0, np.float32),
            track_ids=np.arange(3),
            camera=CAMERA,
            T_base_sensor=SE3.identity(),
            record=record,
        )
        frames.append(replace(keyframe, features=(features,), records=(record,)))
    map_ = append_submap(Map.empty(), replace(submap, keyframes=tuple(frames)))
    landmarks = Landmarks(
        id=id_array(derived_id("landmark", n) for n in range(3)),
        kind=np.array(["klt"] * 3, dtype=object),
        vertex=np.zeros(3, np.int64),
        p_base=np.eye(3) * 4,
    )
    observations = replace(map_.observations, landmark=map_.observations.track)
    return replace(map_, landmarks=landmarks, observations=observations)


def recorded_images(path: Path, stamps_ns: list[int]) -> None:
    data = np.frombuffer(cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes(), np.uint8)
    with McapWriter(path) as writer:
        for stamp_ns in stamps_ns:
            image = EncodedImage(stamp_ns=stamp_ns, data=data, format="jpeg", frame="cam0")
            writer.write("/cam0/image", image, stamp_ns)


def test_P5_observers_cameras_states_and_pictures_are_drawn(tmp_path: Path) -> None:
    recording, file = tmp_path / "drive.mcap", tmp_path / "map.rrd"
    map_ = seen_map(recording)
    recorded_images(recording, map_.vertices.stamp_ns.tolist())

    with strict():
        notes = view_map(map_, None, SinkSpec.parse(f"save={file}").open())

    assert notes == []
    entities = read_rrd(file)
    assert len(values_of(entities["/map/observers/klt"], "LineStrips3D:strips")[0]) == 12
    assert len(values_of(entities[ROBOT], "Transform3D:translation")) == 4
    assert len(values_of(entities[f"{ROBOT}/cam0"], "Pinhole:image_from_camera")) == 1
    assert len(values_of(entities[f"{ROBOT}/cam0"], "EncodedImage:blob")) == 4
    seen = values_of(entities[f"{ROBOT}/cam0/landmarks"], "Points2D:positions")
    lines = values_of(entities[f"{ROBOT}/cam0/residuals"], "LineStrips2D:strips")
    assert [len(points) for points in seen] == [len(each) for each in lines]
    assert len(values_of(entities[f"/states/{MISSION[:8]}/velocity_mps"], "Scalars:scalars")) == 4


def test_P5_a_map_whose_recording_is_gone_is_drawn_without_pictures(tmp_path: Path) -> None:
    file = tmp_path / "map.rrd"

    [note] = view_map(seen_map(tmp_path / "gone.mcap"), None, SinkSpec.parse(f"save={file}").open())

    assert "without pictures" in note
    assert "gone.mcap: no such file" in note
    assert "/map/observers/klt" in read_rrd(file)
