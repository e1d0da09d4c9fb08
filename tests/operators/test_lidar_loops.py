"""Loop closure: which places are tried, what is believed, and that failures add nothing."""

from collections.abc import Sequence

import anyio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.lidar.loops import Inputs, LidarLoops, LidarLoopsConfig, Outputs
from mapstream.operators.lidar.surroundings import Surroundings
from mapstream.operators.lidar.trail import Reach, Trail
from mapstream.operators.testing import run_operator
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Channel, Limits, Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import (
    Keyframe,
    LoopReport,
    MapCorrection,
    Odometry,
    PointCloud,
    Submap,
)
from tests.operators.scenes import room, seen_from

pytestmark = pytest.mark.anyio
MISSION = "0" * 31 + "1"
SECOND_NS = 10**9
WORLD = room(5, num_points=8000)
CONFIG = LidarLoopsConfig(
    min_keyframes=6, min_path_m=4.0, spacing_m=0.5, neighbours=1, max_distance_m=1.2, drift=0.0
)


def circle(num: int = 16) -> list[SE3]:
    """Return poses on a circle of 2 m radius in the hall; the last one is where the first was."""
    turn = 2 * np.pi / (num - 1)
    step = SE3.exp([0, 0, turn, 2 * turn, 0, 0])
    poses = [SE3.exp([0, 0, 0, 0, -2.0, 0])]
    for _ in range(num - 1):
        poses.append(poses[-1] @ step)
    return poses


def submaps(
    truth: Sequence[SE3],
    drift: SE3,
    *,
    world: FloatArray = WORLD,
    last_world: FloatArray = WORLD,
    size: int = 5,
    mission: str = MISSION,
) -> list[Submap]:
    """Return submaps of a drive whose odometry drifts by one more `drift` at each keyframe."""
    T_odom = truth[0]
    frames = []
    for k, T in enumerate(truth):
        if k:
            T_odom = T_odom @ truth[k - 1].inverse() @ T @ drift
        seen = seen_from(last_world if k > len(truth) // 2 else world, T, k)
        cloud = PointCloud(stamp_ns=k * SECOND_NS, points=seen.astype(np.float32))
        odometry = Odometry(stamp_ns=k * SECOND_NS, T_odom_base=T_odom)
        frames.append(Keyframe(stamp_ns=k * SECOND_NS, odometry=odometry, cloud=cloud))
    cuts = range(0, len(frames) - 1, size)
    return [
        Submap(mission_id=mission, index=i, keyframes=tuple(frames[c : c + size + 1]), edges=())
        for i, c in enumerate(cuts)
    ]


async def reports(
    given_submaps: Sequence[Submap], config: LidarLoopsConfig = CONFIG
) -> list[LoopReport]:
    out = await run_operator(LidarLoops(config), submaps=given_submaps)
    return out["loops"]


async def test_I7_a_place_seen_before_closes_the_loop() -> None:
    """After 0.4 m of drift the loop is right to two centimetres, and may be switched off."""
    truth = circle()
    drift = SE3.exp([0, 0, 0.005, 0.01, 0.01, 0.02])

    config = CONFIG.model_copy(update={"neighbours": 0})  # their own drift would blur the target
    found = await reports(submaps(truth, drift), config)

    edges = [edge for report in found for edge in report.edges]
    assert len(found) == 3
    assert edges
    for edge in edges:
        a, b = (truth[stamp // SECOND_NS] for stamp in (edge.stamp_a_ns, edge.stamp_b_ns))
        error = ((a.inverse() @ b).inverse() @ edge.T_a_b).log()
        assert np.linalg.norm(error[3:]) < 0.02
        assert np.linalg.norm(error[:3]) < np.radians(0.3)
        assert edge.stamp_b_ns - edge.stamp_a_ns > 6 * SECOND_NS
        assert edge.kind == "loop"
        assert edge.is_switchable


async def test_I9_a_match_that_is_not_believed_adds_nothing_and_says_why() -> None:
    other = room(77, num_points=8000) * [0.4, 0.5, 1.0]

    found = await reports(submaps(circle(), SE3.identity(), last_world=other))

    candidates = [candidate for report in found for candidate in report.candidates]
    assert candidates
    assert [edge for report in found for edge in report.edges] == []
    assert all("inlier fraction" in c.verdict or "rmse" in c.verdict for c in candidates)


async def test_I9_keyframes_without_clouds_close_no_loop_and_do_not_fail() -> None:
    made = [
        Submap(
            mission_id=s.mission_id,
            index=s.index,
            keyframes=tuple(
                Keyframe(stamp_ns=f.stamp_ns, odometry=f.odometry) for f in s.keyframes
            ),
            edges=(),
        )
        for s in submaps(circle(), SE3.identity())
    ]

    found = await reports(made)

    assert all(report.edges == () for report in found)
    assert {c.verdict for r in found for c in r.candidates} == {"no cloud at 0 ns"}


async def test_every_submap_gets_one_report_with_its_stamp() -> None:
    made = submaps(circle(4), SE3.identity(), size=1)

    found = await reports(made)

    assert [r.stamp_ns for r in found] == [s.stamp_ns for s in made]


async def test_the_same_submaps_give_the_same_loops() -> None:
    made = submaps(circle(), SE3.exp([0, 0, 0.005, 0.02, 0.02, 0.01]))

    first, second = await reports(made), await reports(made)

    poses = [[e.T_a_b.matrix.tobytes() for r in run for e in r.edges] for run in (first, second)]
    assert poses[0] == poses[1]


@pytest.mark.slow
@pytest.mark.parametrize("links", [(1,), (1, 2, 3)])
async def test_I4_keyframes_are_registered_to_those_before_them(links: tuple[int, ...]) -> None:
    config = CONFIG.model_copy(update={"links": links, "min_path_m": 1000.0})
    truth = circle(6)

    found = await reports(submaps(truth, SE3.exp([0, 0, 0.02, 0.05, 0, 0]), size=3), config)

    edges = [edge for report in found for edge in report.edges]
    pairs = {(e.stamp_a_ns // SECOND_NS, e.stamp_b_ns // SECOND_NS) for e in edges}
    assert pairs == {(k - link, k) for link in links for k in range(link, 6)}
    for edge in edges:
        a, b = (truth[stamp // SECOND_NS] for stamp in (edge.stamp_a_ns, edge.stamp_b_ns))
        assert edge.kind == "registration"
        assert np.linalg.norm(((a.inverse() @ b).inverse() @ edge.T_a_b).log()) < 0.03


@pytest.mark.slow
async def test_it_waits_for_the_correction_of_the_submap_before() -> None:
    """Without the correction the drifted place is out of reach, with it the loop is found."""
    truth = circle()
    made = submaps(truth, SE3.exp([0, 0, 0, 0, 0, 0.3]))
    sent: Channel[Submap] = Channel("submaps", Limits(capacity=100))
    heard: Channel[MapCorrection] = Channel("corrections", Limits(capacity=100))
    out: Channel[LoopReport] = Channel("loops", Limits(capacity=100))
    for submap in made:
        await sent.put(submap)
    sent.close()

    async def correct() -> None:
        """Answer each report with the true poses, as a perfect optimizer would."""
        number = 0
        async for report in Receiver(out, spans_epochs=True):
            results.append(report)
            known = [k for k in range(len(truth)) if k * SECOND_NS <= made[number].stamp_ns]
            newest = made[number].keyframes[-1].odometry.T_odom_base
            await heard.put(
                MapCorrection(
                    stamp_ns=made[number].stamp_ns,
                    mission_id=MISSION,
                    stamps_ns=np.array(known) * SECOND_NS,
                    T_mission_base=np.array([truth[k].matrix for k in known]),
                    T_mission_odom=truth[known[-1]] @ newest.inverse(),
                )
            )
            number += 1

    results: list[LoopReport] = []
    inputs = Inputs(Receiver(sent, spans_epochs=True), Receiver(heard, spans_epochs=True))
    with anyio.fail_after(20):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(correct)
            config = CONFIG.model_copy(update={"max_distance_m": 3.0})
            await LidarLoops(config).run(inputs, Outputs(Sender([out])))
            out.close()

    assert [edge for report in results for edge in report.edges]
    assert not [edge for report in await reports(made) for edge in report.edges]


async def test_missions_do_not_mix() -> None:
    other = "0" * 31 + "2"
    half = submaps(circle()[:8], SE3.identity())
    rest = submaps(circle()[8:], SE3.identity(), mission=other)

    found = await reports([*half, *rest])

    assert [edge for report in found for edge in report.edges] == []
    assert len(found) == len(half) + len(rest)


def test_I8_clouds_are_on_disk_and_memory_is_bounded() -> None:
    made = submaps(circle(), SE3.identity())
    trail = Trail()
    limit = 300_000

    with Surroundings(neighbours=2, max_bytes=limit) as surroundings:
        most = 0
        for submap in made:
            surroundings.keep(submap)
            trail.extend(submap)
            most = max(most, surroundings.num_bytes)
        for index in range(len(trail)):
            merged = surroundings.around(MISSION, trail, index)
            most = max(most, surroundings.num_bytes)
            assert len(merged) > len(surroundings.at(MISSION, trail, index))

    total = sum(f.cloud.points.nbytes for s in made for f in s.keyframes if f.cloud is not None)
    assert most <= limit < total


REACH = Reach(min_keyframes=5, min_path_m=3.0, distance_m=1.0, drift=0.02)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_I7_the_candidate_is_the_nearest_far_enough_in_the_past(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal(0, 0.5, (40, 3)), axis=0)
    frames = tuple(
        Keyframe(
            stamp_ns=k,
            odometry=Odometry(stamp_ns=k, T_odom_base=SE3.from_rotation(np.eye(3), p)),
        )
        for k, p in enumerate(positions)
    )
    trail = Trail()
    trail.extend(Submap(mission_id=MISSION, index=0, keyframes=frames, edges=()))

    place = trail.seen_before(39, REACH)

    travelled = trail.path_m(39) - np.array([trail.path_m(k) for k in range(40)])
    distances = np.linalg.norm(positions - positions[39], axis=1)
    allowed = [
        k
        for k in range(39 - 5)
        if travelled[k] >= 3.0 and distances[k] <= 1.0 + 0.02 * travelled[k]
    ]
    if place is None:
        assert allowed == []
    else:
        assert place.index == min(allowed, key=lambda k: distances[k])


def test_I7_after_a_loop_is_solved_the_reach_is_small_again() -> None:
    frames = tuple(
        Keyframe(
            stamp_ns=k,
            odometry=Odometry(stamp_ns=k, T_odom_base=SE3.exp([0, 0, 0, abs(50.0 - k), 0, 0])),
        )
        for k in range(102)
    )
    trail = Trail()
    trail.extend(Submap(mission_id=MISSION, index=0, keyframes=frames, edges=()))
    before = trail.seen_before(100, REACH)
    trail.close(100)
    trail.correct(
        MapCorrection(
            stamp_ns=101,
            mission_id=MISSION,
            stamps_ns=np.arange(102),
            T_mission_base=np.array([f.odometry.T_odom_base.matrix for f in frames]),
            T_mission_odom=SE3.identity(),
        )
    )

    after = trail.seen_before(101, REACH)

    assert before is not None
    assert after is not None
    assert before.reach_m == pytest.approx(1.0 + 0.02 * 100)
    assert after.reach_m == pytest.approx(1.0 + 0.02 * 1)
