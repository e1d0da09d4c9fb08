"""The operator `trajectory`: ports from its config, and the same submaps however messages arrive."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import anyio
import numpy as np
import pytest
from pydantic import ValidationError

from mapstream.operators.backend.live_map import LiveMap
from mapstream.operators.estimation.batch import OptimizeConfig
from mapstream.operators.operator import Ports
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Outputs, Trajectory
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.order import in_canonical_order
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.channel import Channel, Limits, Receiver, Sender
from mapstream.streams.messages.estimates import Submap
from tests.operators.trajectory.drives import MS, fix, imu, odometry, wheels

pytestmark = pytest.mark.anyio

SECOND = 1_000 * MS
CONFIG = TrajectoryConfig.model_validate(
    {
        "sources": {"wheels": {"kind": "wheel"}, "visual": {"kind": "odometry"}},
        "imu": {},
        "constraints": {"fixes": {}},
        "submap_s": 1.0,
    }
)
STREAMS: dict[str, Any] = {
    "wheels": [wheels(s * MS) for s in range(0, 4001, 100)],
    "visual": [odometry(s * MS) for s in range(0, 4034, 33)],
    "imu": [imu(s * MS) for s in range(40, 4041, 50)],
    "fixes": [fix(s * MS) for s in range(7, 4000, 410)],
}


def mapped(submaps: Sequence[Submap]) -> Map:
    map_ = Map.empty()
    for submap in submaps:
        map_ = append_submap(map_, submap)
    return in_canonical_order(map_)


async def test_C2_each_pair_of_poses_has_one_edge_of_each_source() -> None:
    sent = await run_operator(Trajectory(CONFIG), config=CONFIG, **STREAMS)
    map_ = mapped(sent["submaps"])

    assert check_map(map_) == []
    kinds = map_.edges.kind.tolist()
    fixes_and_seconds = len(STREAMS["fixes"]) + 5  # a pose each second, of the first source
    assert len(map_.vertices) == fixes_and_seconds
    assert kinds.count("wheel") == kinds.count("odometry") == kinds.count("imu")
    assert kinds.count("wheel") == len(map_.vertices) - 1
    assert kinds.count("position") == len(STREAMS["fixes"])


async def test_A16_the_mission_keeps_its_sensor_set() -> None:
    sent = await run_operator(Trajectory(CONFIG), config=CONFIG, **STREAMS)

    sensors = json.loads(str(mapped(sent["submaps"]).missions.sensors[0]))

    assert sensors["imu"]["T_base_sensor"] == [0, 0, 0, 0, 0, 0, 1]
    assert sensors["sources"]["wheels"]["kind"] == "wheel"


async def test_G5_predictions_run_ahead_of_the_submaps() -> None:
    sent = await run_operator(Trajectory(CONFIG), config=CONFIG, **STREAMS)

    stamps = [prediction.stamp_ns for prediction in sent["predictions"]]
    assert stamps == sorted(stamps)
    assert stamps[-1] == STREAMS["wheels"][-1].stamp_ns
    newest, before = sent["predictions"][-1], sent["predictions"][-2]
    step = before.T_odom_base.inverse() @ newest.T_odom_base
    assert np.linalg.norm(step.t) == pytest.approx(0.1, rel=0.02)


async def fed_live(pauses: np.random.Generator) -> list[Submap]:
    """Feed the inputs from tasks of their own, in arrival order with random pauses between them."""
    operator = Trajectory(CONFIG)
    channels: dict[str, Channel[Any]] = {
        name: Channel(name, Limits(capacity=4)) for name in STREAMS
    }
    out: Channel[Any] = Channel("submaps", Limits(capacity=1000))

    async def feed(name: str) -> None:
        for message in STREAMS[name]:
            for _ in range(int(pauses.integers(0, 4))):
                await anyio.lowlevel.checkpoint()
            await channels[name].put(message)
        channels[name].close()

    async with anyio.create_task_group() as tasks:
        for name in STREAMS:
            tasks.start_soon(feed, name)
        receivers = {name: Receiver(channel) for name, channel in channels.items()}
        await operator.run(Ports(**receivers), Outputs(Sender([out]), Sender([])))
    out.close()
    return [submap async for submap in Receiver(out)]


@pytest.mark.parametrize("seed", range(3))
async def test_B4_live_arrival_and_replay_give_the_same_map(seed: int) -> None:
    replayed = (await run_operator(Trajectory(CONFIG), config=CONFIG, **STREAMS))["submaps"]

    live = await fed_live(np.random.default_rng(seed))

    assert mapped(live).digest() == mapped(replayed).digest()
    digests = []
    for submaps in (live, replayed):
        growing = LiveMap(OptimizeConfig())
        for submap in submaps:
            growing.append(submap)
        digests.append(growing.ordered().digest())
    assert digests[0] == digests[1]


async def test_B6_what_its_port_calls_late_still_finds_its_place() -> None:
    """A fix that comes behind newer ones splits what went out, and the graph is that of the right order."""
    late = [*STREAMS["fixes"][:2], *STREAMS["fixes"][3:], STREAMS["fixes"][2]]
    in_order = await run_operator(Trajectory(CONFIG), config=CONFIG, **STREAMS)

    spliced = await run_operator(Trajectory(CONFIG), config=CONFIG, **{**STREAMS, "fixes": late})

    assert any(submap.splices for submap in spliced["submaps"])
    first, second = mapped(in_order["submaps"]), mapped(spliced["submaps"])
    assert check_map(second) == []
    np.testing.assert_array_equal(first.vertices.id, second.vertices.id)
    np.testing.assert_array_equal(first.edges.id, second.edges.id)
    np.testing.assert_array_equal(first.edges.T_a_b, second.edges.T_a_b)
    np.testing.assert_array_equal(first.imu.stamp_ns, second.imu.stamp_ns)


async def test_B6_inside_isam2_a_splice_takes_the_old_edges_out() -> None:
    late = [*STREAMS["fixes"][:2], *STREAMS["fixes"][3:], STREAMS["fixes"][2]]
    spliced = await run_operator(Trajectory(CONFIG), config=CONFIG, **{**STREAMS, "fixes": late})
    in_order = await run_operator(Trajectory(CONFIG), config=CONFIG, **STREAMS)

    solved = []
    for submaps in (spliced["submaps"], in_order["submaps"]):
        live = LiveMap(OptimizeConfig())
        for submap in submaps:
            live.append(submap)
        live._problem.settle()
        live._take()
        assert live._problem.names >= {
            row.tobytes() for row in live.map.edges.id[live.map.edges.kind != "position"]
        }
        solved.append(live.ordered().vertices.T_mission_base)

    np.testing.assert_allclose(solved[0], solved[1], atol=1e-3)


def test_two_inputs_of_one_name_are_refused() -> None:
    with pytest.raises(ValidationError, match="two inputs are called imu"):
        TrajectoryConfig.model_validate({"sources": {"imu": {"kind": "wheel"}}})


@pytest.mark.parametrize(
    ("without", "missing"), [("wheels", "wheel"), ("imu", "imu"), ("fixes", "position")]
)
async def test_N6_an_input_that_is_left_out_leaves_no_edge(without: str, missing: str) -> None:
    """Each source can be switched off where it is wired, to see what it is worth."""
    config = CONFIG.model_copy(update={"without": (without,)})

    sent = await run_operator(Trajectory(config), config=config, **STREAMS)

    kinds = set(mapped(sent["submaps"]).edges.kind.tolist())
    assert kinds == {"wheel", "odometry", "imu", "position"} - {missing}
    with pytest.raises(ValidationError, match="without: no input wheel; there are wheels"):
        TrajectoryConfig.model_validate(
            {"sources": {"wheels": {"kind": "wheel"}}, "without": ["wheel"]}
        )
