"""Robots of W-MR from their recordings to maps: all rates and delays at once, and different robots in one map."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from mapstream.graph.load import load_graph
from mapstream.graph.plan import plan
from mapstream.graph.report import RunReport
from mapstream.graph.run import run_graph
from mapstream.recordings.maps import Map, load_map, save_map
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.recording import open_recording
from mapstream.recordings.worlds.catalogue import simulate

SMALL: dict[str, Any] = {
    "duration_s": 2.5,
    "texel_m": 0.5,
    "camera": {"width_px": 96, "height_px": 72},
    "rgbd": {"width_px": 64, "height_px": 48, "rate_hz": 5.0},
    "lidar": {"beams": 16, "columns": 64},
    "objects_hz": 5.0,
}
DELAYS = {
    "/gnss": 2.0,
    "/front_left/image": 0.1,
    "/front_right/image": 0.15,
    "/front_left/objects": 0.5,
    "/points": 0.3,
    "/wheels": 0.05,
}
TOPICS = {
    "odometry": "/odometry",
    "imu": "/imu",
    "wheels": "/wheels",
    "fixes": "/gnss",
    "left": "/front_left/image",
    "right": "/front_right/image",
    "color": "/color/image",
    "detections": "/front_left/objects",
    "scans": "/points",
}
KLT = {"max_tracks": 20}
STAGES: dict[str, dict[str, Any]] = {
    "left": {"use": "image_decode", "in": {"images": "sensors.left"}, "config": {"mode": "gray"}},
    "right": {"use": "image_decode", "in": {"images": "sensors.right"}, "config": {"mode": "gray"}},
    "color": {"use": "image_decode", "in": {"images": "sensors.color"}, "config": {"mode": "gray"}},
    "stereo_tracks": {
        "use": "klt",
        "in": {"frames": "left.frames", "right_frames": "right.frames"},
        "config": KLT,
    },
    "color_tracks": {"use": "klt", "in": {"frames": "color.frames"}, "config": KLT},
    "objects": {"use": "object_features", "in": {"detections": "sensors.detections"}},
    "kiss": {"use": "kiss_odometry", "in": {"scans": "sensors.scans"}},
    "gnss": {"use": "gnss", "in": {"fixes": "sensors.fixes"}},
}


@dataclass(frozen=True)
class Robot:
    """What of a robot goes into its map, and how."""

    topics: tuple[str, ...]
    stages: tuple[str, ...]
    seen: dict[str, str]  # features of its n-frames
    measured: dict[str, str]  # inputs of the trajectory beside these
    sources: tuple[str, ...]  # of motion, among them

    def graph(self) -> dict[str, Any]:
        """Return its graph; JSON is YAML."""
        n_frames = {
            "use": "n_frames",
            "in": self.seen,
            "config": {
                "inputs": list(self.seen),
                "slower": [each for each in self.seen if each == "objects"],
            },
        }
        trajectory = {
            "sources": {
                s: {"kind": "wheel" if s == "wheels" else "odometry"} for s in self.sources
            },
            **({"imu": {"recording": "$recording"}} if "imu" in self.measured else {}),
            "clouds": "clouds" in self.measured,
            "n_frames": bool(self.seen),
            "constraints": {"fixes": {"period_s": 1.0}} if "fixes" in self.measured else {},
            "window_s": 2.5,
            "period_s": 1.0,
        }
        features = {"n_frames": "n_frames.n_frames"} if self.seen else {}
        submaps = {"submaps": "trajectory.submaps"}
        topics = {name: TOPICS[name] for name in self.topics}
        operators = {
            "sensors": {
                "use": "mcap",
                "config": {"path": "$recording", "topics": topics, "lateness_s": 2.1},
            },
            **{name: STAGES[name] for name in self.stages},
            **({"n_frames": n_frames} if self.seen else {}),
            "trajectory": {
                "use": "trajectory",
                "in": self.measured | features,
                "config": trajectory,
            },
            "optimizer": {
                "use": "optimizer",
                "in": submaps,
                "config": {"batch": {"underconstrained": "prior"}},
            },
            "store": {
                "use": "map_store",
                "in": {"maps": "optimizer.maps"} | submaps,
                "config": {"path": "$map"},
            },
        }
        params = {"recording": {"type": "path"}, "map": {"type": "path"}}
        return {"version": 1, "name": "robot", "params": params, "operators": operators}


STEREO = {"left": "stereo_tracks.features", "right": "stereo_tracks.right_features"}
INERTIAL = {"odometry": "sensors.odometry", "imu": "sensors.imu"}
LASER = {"kiss": "kiss.odometry", "clouds": "kiss.clouds", "wheels": "sensors.wheels"}
CAMERA = Robot(
    ("odometry", "imu", "left", "right"),
    ("left", "right", "stereo_tracks"),
    STEREO,
    INERTIAL,
    ("odometry",),
)
LIDAR = Robot(("wheels", "scans"), ("kiss",), {}, LASER, ("kiss", "wheels"))
RGBD = Robot(
    ("odometry", "color"),
    ("color", "color_tracks"),
    {"color": "color_tracks.features"},
    {"odometry": "sensors.odometry"},
    ("odometry",),
)
FULL = Robot(
    ("imu", "wheels", "fixes", "left", "right", "detections", "scans"),
    ("left", "right", "stereo_tracks", "objects", "kiss", "gnss"),
    STEREO | {"objects": "objects.features"},
    LASER | {"imu": "sensors.imu", "fixes": "gnss.constraints"},
    ("kiss", "wheels"),
)


def mapped(folder: Path, how: Robot, **options: Any) -> tuple[Map, RunReport, Path]:  # noqa: ANN401  # as in a config
    """Return the map of a robot that was recorded with options, and how the run went."""
    recording = simulate("w_mr", folder / "robot.mcap", **SMALL | options)
    (folder / "graph.yaml").write_text(json.dumps(how.graph()))
    params = {"recording": str(recording), "map": str(folder / "map")}
    report = anyio.run(run_graph, plan(load_graph(folder / "graph.yaml", params=params)))
    return load_map(folder / "map"), report, recording


@pytest.mark.slow
def test_B8_the_rates_and_delays_of_a_whole_robot_lose_nothing(tmp_path: Path) -> None:
    """IMU 200 Hz, cameras 20, LiDAR 10, satellites 1 Hz; 0 to 2 s late; every message arrives, in the map too."""
    map_, report, recording = mapped(tmp_path, FULL, robot="full", delays_s=DELAYS)

    assert report.status == "complete", report.reasons
    with open_recording(recording) as opened:
        counts = {name: opened.topics[TOPICS[name]].count for name in FULL.topics}
    assert {name: counts[name] for name in ("left", "scans", "fixes")} == {
        "left": 51,
        "scans": 25,
        "fixes": 3,
    }
    for edge in report.final.edges:
        assert edge.late == 0, edge.name
        assert not edge.dropped, edge.name
        source, _, port = edge.name.split(" ")[0].partition(".")
        if source == "sensors" and port != "imu":  # whose batches are made anew
            assert edge.sent == edge.received == counts[port], edge.name
    assert (map_.edges.kind == "position").sum() == counts["fixes"]
    assert {"klt", "object"} <= set(map_.observations.kind)
    assert (map_.resources.kind == "cloud").any()


@pytest.mark.slow
def test_A16_three_different_robots_live_in_one_map(tmp_path: Path) -> None:
    """Camera and IMU, LiDAR and wheels, colour and depth: each mission has its own sensors, also after loading."""
    maps = []
    for kind, robot in (("camera", CAMERA), ("lidar", LIDAR), ("rgbd", RGBD)):
        (tmp_path / kind).mkdir()
        map_, report, _ = mapped(tmp_path / kind, robot, robot=kind, objects=None)
        assert report.status == "complete", report.reasons
        maps.append(map_)

    merged = merge_maps(maps)
    save_map(merged, tmp_path / "all")
    loaded = load_map(tmp_path / "all")

    assert loaded.digest() == merged.digest()
    sets = {loaded.mission_id(row): loaded.missions.sensors[row] for row in range(3)}
    assert sets == {map_.mission_id(0): map_.missions.sensors[0] for map_ in maps}
    described = [json.loads(sets[map_.mission_id(0)]) for map_ in maps]
    assert [sorted(each.get("cameras", {})) for each in described] == [
        ["front_left", "front_right"],
        [],
        ["color"],
    ]
    assert len({json.dumps(each, sort_keys=True) for each in described}) == 3
    assert np.bincount(loaded.vertices.mission).min() >= 3
