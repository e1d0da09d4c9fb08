"""From the scans of W-LID to a map: odometry, keyframes, submaps, loops and optimizer, side by side."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import anyio
import numpy as np
import pytest

from mapstream.operators.backend.optimizer import Inputs as OptimizerInputs
from mapstream.operators.backend.optimizer import Optimizer, OptimizerConfig
from mapstream.operators.backend.optimizer import Outputs as OptimizerOutputs
from mapstream.operators.lidar.loops import Inputs as LoopInputs
from mapstream.operators.lidar.loops import LidarLoops, LidarLoopsConfig
from mapstream.operators.lidar.loops import Outputs as LoopOutputs
from mapstream.operators.lidar.sampling import voxel_keys
from mapstream.operators.odometry.gicp_odometry import GicpOdometry, GicpOdometryConfig
from mapstream.operators.odometry.kiss_odometry import KissOdometry, KissOdometryConfig
from mapstream.operators.operator import Context, Operator, set_context
from mapstream.operators.submaps.keyframes import Keyframes, KeyframesConfig
from mapstream.operators.submaps.submap_builder import SubmapBuilder, SubmapBuilderConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.recordings.worlds.sensors import LidarConfig
from mapstream.recordings.worlds.w_lid import WLidConfig, w_lid
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Channel, Limits, Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry, PointCloud, Submap
from mapstream.streams.trajectory import Trajectory

pytestmark = [pytest.mark.anyio, pytest.mark.slow]
UNBOUNDED = Limits(capacity=10**6)
LIDAR = LidarConfig(beams=16, columns=200)


@dataclass(frozen=True)
class Tracked:
    odometry: list[Odometry]
    clouds: list[PointCloud]


@cache
def recording(*, aggressive: bool = False) -> dict[str, list[Any]]:
    """Return the messages of a small W-LID by topic."""
    config = WLidConfig(length_m=36.0, overlap_fraction=0.15, aggressive=aggressive, lidar=LIDAR)
    topics: dict[str, list[Any]] = {}
    for record in w_lid(config, seed=1).records:
        topics.setdefault(record.topic, []).append(record.message)
    return topics


def truth_of(topics: dict[str, list[Any]]) -> Trajectory:
    messages: list[Odometry] = topics["/truth"]
    return Trajectory(
        stamps_ns=np.array([m.stamp_ns for m in messages]),
        poses=np.array([m.T_odom_base.matrix for m in messages]),
    )


async def tracked(
    operator: GicpOdometry | KissOdometry,
    topics: dict[str, list[Any]],
    *,
    with_imu: bool = False,
    num_scans: int | None = None,
) -> Tracked:
    imu = topics["/imu"] if with_imu else []
    out = await run_operator(operator, scans=topics["/points"][:num_scans], imu=imu)
    return Tracked(out["odometry"], out["clouds"])


_gicp: list[Tracked] = []  # two tests begin with the same odometry


async def tracked_by_gicp() -> Tracked:
    if not _gicp:
        _gicp.append(await tracked(GicpOdometry(GicpOdometryConfig()), recording()))
    return _gicp[0]


async def submaps_of(tracked: Tracked) -> list[Submap]:
    keyframes = await run_operator(
        Keyframes(KeyframesConfig()), odometry=tracked.odometry, clouds=tracked.clouds
    )
    out = await run_operator(SubmapBuilder(SubmapBuilderConfig()), keyframes=keyframes["keyframes"])
    return out["submaps"]


async def map_of(
    submaps: list[Submap], config: LidarLoopsConfig, search_loops: Operator[Any, Any] | None = None
) -> list[Map]:
    """Run loop search and optimizer beside each other, each waiting for the other."""
    to_loops: Channel[Any] = Channel("submaps", UNBOUNDED)
    to_optimizer: Channel[Any] = Channel("submaps", UNBOUNDED)
    loops: Channel[Any] = Channel("loops", UNBOUNDED)
    corrections: Channel[Any] = Channel("corrections", UNBOUNDED)
    maps: Channel[Any] = Channel("maps", UNBOUNDED)

    def receive(channel: Channel[Any]) -> Receiver[Any]:
        return Receiver(channel, spans_epochs=True)

    for submap in submaps:
        await to_loops.put(submap)
        await to_optimizer.put(submap)
    to_loops.close()
    to_optimizer.close()

    async def search() -> None:
        inputs = LoopInputs(receive(to_loops), receive(corrections))
        await (search_loops or LidarLoops(config)).run(inputs, LoopOutputs(Sender([loops])))
        loops.close()

    async def optimize() -> None:
        inputs = OptimizerInputs(receive(to_optimizer), receive(loops))
        outputs = OptimizerOutputs(Sender([corrections]), Sender([maps]))
        await Optimizer(OptimizerConfig(map_every_submaps=1)).run(inputs, outputs)
        corrections.close()
        maps.close()

    set_context(Context())
    with anyio.fail_after(120):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(search)
            tasks.start_soon(optimize)
    return [message async for message in receive(maps)]


def errors_m(map_: Map, truth: Trajectory) -> FloatArray:
    """Return the distances (N,) from the truth, both starting at the same pose."""
    found = map_.trajectory(map_.mission_id(0))
    inside = [k for k, stamp_ns in enumerate(found.stamps_ns) if truth.covers(int(stamp_ns))]
    T_truth_map = truth.at(found.stamps_ns[:1])[0] @ np.linalg.inv(found.poses[0])
    shifts = (T_truth_map @ found.poses[inside])[:, :3, 3]
    distances: FloatArray = np.linalg.norm(
        shifts - truth.at(found.stamps_ns[inside])[:, :3, 3], axis=1
    )
    return distances


LOOPS = LidarLoopsConfig(max_distance_m=1.4)


async def test_I7_O1_the_loop_closes_and_a_map_follows_each_optimisation() -> None:
    """End error below 0.05 m, no worse than without loops; the same bytes again."""
    topics = recording()
    submaps = await submaps_of(await tracked_by_gicp())

    maps, again = await map_of(submaps, LOOPS), await map_of(submaps, LOOPS)

    final = maps[-1]
    assert len(final.edges_of("loop")) > 0
    assert errors_m(final, truth_of(topics))[-1] < 0.05
    assert len(maps) == len(submaps) + 1  # after each, and after the batch at the end
    assert list(check_map(final)) == []
    assert final.digest() == again[-1].digest()


async def test_K1_poses_of_the_beginning_move_when_a_loop_closes() -> None:
    """Nothing is marginalised: the loop corrects vertices of long before it."""
    topics = recording()
    straight = await tracked_by_gicp()
    bent = [_bent(o, k) for k, o in enumerate(straight.odometry)]
    submaps = await submaps_of(Tracked(bent, straight.clouds))

    maps = await map_of(submaps, LidarLoopsConfig(max_distance_m=3.0))

    before = maps[0].vertices.T_mission_base[:8, :3, 3]
    after = maps[-1].vertices.T_mission_base[:8, :3, 3]
    assert np.linalg.norm(after - before, axis=1).max() > 0.005
    assert errors_m(maps[-1], truth_of(topics))[-1] < 0.2


def _bent(odometry: Odometry, number: int) -> Odometry:
    """Return the odometry with a drift of a centimetre a second to the side."""
    return Odometry(
        stamp_ns=odometry.stamp_ns,
        T_odom_base=SE3.from_rotation(np.eye(3), [0, 0.001 * number, 0]) @ odometry.T_odom_base,
        covariance=np.diag([1e-6] * 3 + [1e-4] * 3),
    )


async def test_registered_keyframes_take_out_what_point_to_point_odometry_drifts() -> None:
    """KISS-ICP locks to the rings of the scan in this corridor; links to the keyframes before do not."""
    topics = recording()
    submaps = await submaps_of(
        await tracked(KissOdometry(KissOdometryConfig()), topics, num_scans=120)
    )

    maps = await map_of(submaps, LidarLoopsConfig(max_distance_m=1.4, links=(1, 2)))

    truth = truth_of(topics)
    T_odom_base = submaps[-1].keyframes[-1].odometry.T_odom_base
    T_true = truth.between(submaps[0].keyframes[0].stamp_ns, submaps[-1].stamp_ns)
    assert np.linalg.norm(T_true.t - T_odom_base.t) > 0.5
    assert errors_m(maps[-1], truth)[-1] < 0.2


@pytest.mark.parametrize("with_imu", [False, True])
async def test_I17_spinning_at_90_degrees_a_second_leaves_thin_walls(*, with_imu: bool) -> None:
    """Root mean square of the distances from planes: below 3 cm, and more without deskewing."""
    topics = recording(aggressive=True)
    config = GicpOdometryConfig(cloud_voxel_size_m=0.1)

    thin = await tracked(GicpOdometry(config), topics, with_imu=with_imu, num_scans=70)

    assert thickness_m(thin) < 0.03
    if not with_imu:
        config = config.model_copy(update={"deskew": False})
        assert thickness_m(await tracked(GicpOdometry(config), topics, num_scans=70)) > 0.03


def thickness_m(tracked: Tracked) -> float:
    """Return how far a map's points lie from planes through the points of 0.25 m, where they are many."""
    pairs = zip(tracked.odometry[20:], tracked.clouds[20:], strict=True)  # at first it stands
    points = np.concatenate([o.T_odom_base @ c.points.astype(np.float64) for o, c in pairs])
    _, voxel, counts = np.unique(voxel_keys(points, 0.25), return_inverse=True, return_counts=True)
    groups = np.split(points[np.argsort(voxel, kind="stable")], np.cumsum(counts)[:-1])
    spreads = []
    for group in groups:
        if len(group) >= 30:
            sizes = np.linalg.svd(group - group.mean(axis=0), compute_uv=False)
            if sizes[1] > 0.03 * np.sqrt(len(group)):  # a surface, not an edge
                spreads.append(sizes[2] ** 2 / len(group))
    return float(np.sqrt(np.mean(spreads)))
