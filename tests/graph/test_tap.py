"""The tap draws what flows, and never slows it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from mapstream.graph.plan import Plan
from mapstream.graph.run import run_graph
from mapstream.graph.spec import LogSpec, ProfileSpec, RerunSpec
from mapstream.graph.tap import RerunTap
from mapstream.graph.tap_outputs import drawn_outputs, main_odometry
from mapstream.graph.tap_sinks import DEFAULT_URL, SinkSpec
from mapstream.streams.errors import ConfigError
from tests.graph import made_messages as made
from tests.graph.picture_stages import drive_plan
from tests.graph.rrd import columns_of, read_rrd, strict, unused_url, values_of

pytestmark = pytest.mark.anyio


class SlowSink:
    """A viewer that stops reading until it is told to go on, as one under SIGSTOP."""

    is_file = False
    patience_s = 0.05

    def __init__(self) -> None:
        self.may_go_on = Event()
        self.drawn: Counter[str] = Counter()

    def try_open(self, blueprint: object) -> bool:
        return True

    def draw(self, path: str, drawing: Iterable[Any], *, stamp_ns: int, sequence: int) -> None:
        self.may_go_on.wait()
        self.drawn[path] += 1

    def flush(self, timeout_s: float) -> bool:
        return True

    def close(self) -> None:
        self.may_go_on.wait()


def with_rerun(plan: Plan, **rules: list[str]) -> Plan:
    return replace(plan, log=LogSpec(rerun=RerunSpec.model_validate(rules)))


async def test_P2_a_run_is_drawn_into_a_file(tmp_path: Path) -> None:
    """Scans, odometry, submaps, loops, map and the operator graph can be read back; nothing is lost."""
    plan, file = drive_plan(), tmp_path / "run.rrd"
    with strict(), RerunTap(plan, SinkSpec.parse(f"save={file}").open()) as tap:
        report = await run_graph(plan, taps=[tap], on_progress=tap.on_progress)

    assert report.status == "complete"
    assert tap.notes() == []
    entities = read_rrd(file)
    assert len(values_of(entities["/drive/scans"], "Points3D:positions")) == 12
    assert len(values_of(entities["/frames/base"], "Transform3D:translation")) == 12
    assert len(values_of(entities["/drive/clouds"], "Points3D:positions")) == 12
    submaps = {name.split("/")[4] for name in entities if name.startswith("/map/submaps/")}
    assert submaps == {"0", "1", "2"}
    assert "LineStrips3D:strips" in columns_of(entities["/map/edges/loop"])
    assert f"/map/trajectory/{made.MISSION[:8]}" in entities
    assert {"GraphNodes:node_ids", "GraphEdges:edges"} <= columns_of(entities["/run/graph"])
    assert columns_of(entities["/drive/scans"]) >= {"stamp", "seq"}


async def test_P7_rates_queues_and_load_are_plotted(tmp_path: Path) -> None:
    plan, file = drive_plan(), tmp_path / "run.rrd"
    with strict(), RerunTap(plan, SinkSpec.parse(f"save={file}").open()) as tap:
        await run_graph(plan, taps=[tap], on_progress=tap.on_progress)

    entities = read_rrd(file)
    assert "Scalars:scalars" in columns_of(entities["/run/load/drive"])
    edges = {name.split("/")[2] for name in entities if name.startswith("/run/")}
    assert {"graph", "load", "rates", "queues"} <= edges
    labels = values_of(entities["/run/graph"], "GraphNodes:labels")
    assert "busy" in labels[-1][0]


async def test_O1_a_stopped_viewer_does_not_slow_the_run() -> None:
    """All is sent while the viewer takes nothing; memory stays bounded and the loss is said."""
    plan, sink = drive_plan(num_steps=100, num_points=2000), SlowSink()
    tap = RerunTap(plan, sink, max_bytes=200_000)
    report = await run_graph(plan, taps=[tap])
    tap.close()
    sink.may_go_on.set()  # only now: had the run waited for the viewer, it would wait for ever

    assert {edge.received for edge in report.final.edges if "scans" in edge.name} == {100}
    assert tap.queue.high_water_bytes <= 200_000
    assert any("not drawn" in note for note in tap.notes())


async def test_O1_the_tap_sees_every_map() -> None:
    plan, sink = drive_plan(), SlowSink()
    sink.may_go_on.set()
    with RerunTap(with_rerun(plan, edges=["*.maps"]), sink) as tap:
        await run_graph(plan, taps=[tap])

    seen = sink.drawn["drive/maps"] + tap.queue.lost["drive/maps", "newer"]
    assert seen == 3
    assert set(sink.drawn) == {"drive/maps"}


def test_P2_the_graph_file_says_what_is_drawn() -> None:
    plan = with_rerun(drive_plan(), **{"edges": ["drive.*"], "except": ["*.frames", "*.scans"]})

    paths = {output.path for output in drawn_outputs(plan)}

    assert "drive/odometry" in paths
    assert not paths & {"drive/frames", "drive/scans"}


def test_the_odometry_of_the_map_moves_the_robot() -> None:
    main = main_odometry(drive_plan(), drawn_outputs(drive_plan()))

    assert main is not None
    assert main.path == "drive/odometry"


def test_a_live_run_never_waits_even_for_a_file(tmp_path: Path) -> None:
    live = ProfileSpec.model_validate({"clock": {"from": "wall"}})
    sink = SinkSpec.parse(f"save={tmp_path / 'run.rrd'}").open()

    with RerunTap(replace(drive_plan(), profile=live), sink) as tap:
        assert not tap.queue.is_lossless


async def test_without_a_viewer_a_run_ends_soon_and_says_so() -> None:
    plan = drive_plan()
    with RerunTap(plan, SinkSpec.parse(f"connect={unused_url()}").open()) as tap:
        await run_graph(plan, taps=[tap])

    assert any("no viewer answered" in note for note in tap.notes())


def test_a_drawing_that_fails_is_counted_and_the_rest_is_drawn(tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    mute = replace(made.sensor_messages()["gnss"], latitude_deg="north")  # type: ignore[type-var]
    with strict(), RerunTap(drive_plan(), SinkSpec.parse(f"save={file}").open()) as tap:
        tap.queue.put("drive/gnss", mute)
        tap.queue.put("drive/odometry", made.odometry(0))

    assert any("cannot draw GnssFix" in note for note in tap.notes())
    assert "/frames/base" in read_rrd(file)


def test_a_file_that_cannot_be_written_ends_the_drawing_alone(tmp_path: Path) -> None:
    with RerunTap(drive_plan(), SinkSpec.parse(f"save={tmp_path}").open()) as tap:
        tap.queue.put("drive/odometry", made.odometry(0))

    assert any("drawing ended" in note for note in tap.notes())


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("sav=x", "expected spawn, connect"),
        ("save=", "expected spawn, connect"),
        ("save=/nowhere/at/all/x.rrd", "there is no folder"),
        ("connect=127.0.0.1:9876", "expected a url like"),
    ],
)
def test_a_wrong_sink_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        SinkSpec.parse(text)


def test_a_viewer_cannot_open_without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)

    with pytest.raises(ConfigError, match="no display"):
        SinkSpec.parse("spawn").open()


def test_connect_without_a_url_means_this_machine() -> None:
    assert SinkSpec.parse("connect").target == DEFAULT_URL
