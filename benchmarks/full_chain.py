"""The full chain in real time: `python benchmarks/full_chain.py`.

The preset `full` maps W-MR's robot with a stereo camera at 20 Hz, a LiDAR at 10 Hz and an IMU at 200 Hz. Played as fast
as it goes, each stage's processor time is its share of what two cores have in the time that the recording lasts; played
as its sensors would go on, what the machine cannot do in time is dropped and counted.
The detector is one of those beside the shared data; without it there are no rows. It knows nothing that stands in W-MR:
it works, and what the recording's own detector tells goes on instead. It takes about three minutes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from importlib.resources import files
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.graph.trajectory_sources import read_trajectory
from mapstream.recordings.evaluation import ape
from mapstream.recordings.pose_pairs import associate
from mapstream.recordings.worlds.catalogue import simulate

_MODEL = Path(__file__).parents[2] / "shared" / "models" / "yolox_nano_416.onnx"
_DURATION_S = 30.0
_OBJECTS_HZ = 5.0  # the preset's
_CORES = 2


def _graph(path: Path) -> Path:
    """Write the preset `full` with a detector whose objects come from the recording."""
    yaml = YAML(typ="safe")
    graph = yaml.load((files("mapstream") / "graph" / "presets" / "full.yaml").read_text())
    operators = graph["operators"]
    operators["sensors"]["config"]["topics"]["objects"] = "/front_left/objects"
    operators["recorded"] = {"use": "external_detections", "in": {"detections": "sensors.objects"}}
    operators["masks"]["in"]["detections"] = "recorded.detections"
    yaml.dump(graph, path)
    return path


def _mapped(graph: Path, recording: Path, folder: Path, *options: str) -> dict[str, Any]:
    """Return what a run says of itself, as JSON."""
    command = [sys.executable, "-m", "mapstream.graph.cli", "run", graph, recording]
    command += ["--param", f"model={_MODEL}", "--map", folder, "--rerun", "off", "--json", *options]
    ran = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, check=False
    )
    if not ran.stdout:
        raise RuntimeError(ran.stderr)
    said: dict[str, Any] = json.loads(ran.stdout)
    return said


def _stages(replay: dict[str, Any]) -> list[Row]:
    available_s = _CORES * _DURATION_S
    rows = [
        Row(
            what=f"processor time of {stage['name']} ({stage['use']})",
            ours=f"{stage['cpu_s']:.2f} s",
            other=f"{_CORES} cores x {_DURATION_S:.0f} s",
            ratio=stage["cpu_s"] / available_s,
        )
        for stage in sorted(replay["operators"], key=lambda each: -each["cpu_s"])
        if stage["cpu_s"] >= 0.001 * available_s
    ]
    whole = Row(
        what="processor time of the full chain",
        ours=f"{replay['cpu_s']:.1f} s",
        other=f"{_CORES} cores x {_DURATION_S:.0f} s",
        ratio=replay["cpu_s"] / available_s,
        bar="at most 1",
    )
    return [whole, *rows]


def run() -> list[Row]:
    """Return each stage's share, and how live mapping compares with a replay."""
    if not _MODEL.is_file():
        return []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        recording = folder / "robot.mcap"
        simulate("w_mr", recording, robot="full", duration_s=_DURATION_S, objects_hz=_OBJECTS_HZ)
        graph = _graph(folder / "full.yaml")
        replay = _mapped(graph, recording, folder / "replay")
        live = _mapped(graph, recording, folder / "live", "--profile", "real_time")
        truth = read_trajectory(recording)
        errors_m = [
            ape(associate(read_trajectory(folder / name), truth)).translation.rmse
            for name in ("replay", "live")
        ]
    dropped = sum(sum(edge["dropped"].values()) for edge in live["edges"])
    passed = sum(edge["received"] for edge in live["edges"])
    return [
        *_stages(replay),
        Row(
            what="live: time from the first message to the saved map",
            ours=f"{live['wall_s']:.1f} s",
            other=f"the recording: {_DURATION_S:.0f} s",
            ratio=live["wall_s"] / _DURATION_S,
        ),
        Row(
            what="live: messages dropped",
            ours=str(dropped),
            other=f"passed on: {passed}",
            ratio=dropped / max(passed, 1),
        ),
        Row(
            what="live: trajectory error",
            ours=f"{100 * errors_m[1]:.2f} cm",
            other=f"replay {100 * errors_m[0]:.2f} cm",
            ratio=errors_m[1] / errors_m[0],
        ),
    ]


if __name__ == "__main__":
    print(markdown(run()))
