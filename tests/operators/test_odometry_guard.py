"""Steps that no robot can make are found; all others pass as they are."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.odometry.odometry_guard import (
    Inputs,
    OdometryGuard,
    OdometryGuardConfig,
    Outputs,
)
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.channel import Channel, Limits, Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry

pytestmark = pytest.mark.anyio
JUMP_AT = 30


def drive(
    period_s: float, *, jump: SE3 | None = None, speed_mps: float = 3.0, turn_radps: float = 0.5
) -> list[Odometry]:
    """A robot that starts from rest, drives a curve, and jumps once."""
    T, messages = SE3.identity(), []
    for i in range(60):
        if jump is not None and i == JUMP_AT:
            T = T @ jump
        messages.append(
            Odometry(
                stamp_ns=10**18 + round(i * period_s * 1e9), T_odom_base=T, velocity_mps=np.ones(3)
            )
        )
        gain = min(1.0, i * period_s)  # to full speed within a second
        T = T @ SE3.exp(np.array([0, 0, turn_radps, speed_mps, 0, 0]) * gain * period_s)
    return messages


async def guarded(
    messages: list[Odometry], on_jump: Literal["inflate", "bridge", "split"] = "inflate"
) -> tuple[list[Odometry], Context]:
    found = Context()
    guard = OdometryGuard(OdometryGuardConfig(on_jump=on_jump))
    sent = await run_operator(guard, run_context=found, odometry=messages)
    return sent["odometry"], found


def turn_of(sent: list[Odometry]) -> float:
    return (sent[JUMP_AT - 1].T_odom_base.inverse() @ sent[JUMP_AT].T_odom_base).angle_rad


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.15])
async def test_C15_a_jump_of_half_a_metre_is_flagged_and_its_covariance_inflated(
    period_s: float,
) -> None:
    messages = drive(period_s, jump=SE3.exp([0, 0, 0, 0, 0.5, 0]))

    sent, found = await guarded(messages)

    flagged = [i for i, message in enumerate(sent) if message.covariance is not None]
    assert flagged == [JUMP_AT]
    covariance = sent[JUMP_AT].covariance
    assert covariance is not None
    assert np.sqrt(covariance[4, 4]) == pytest.approx(0.55, abs=0.02)
    assert found.activity.warnings == {
        "steps of the odometry that no robot makes: they count little": 1
    }
    for before, after in zip(messages, sent, strict=True):
        np.testing.assert_array_equal(after.T_odom_base.matrix, before.T_odom_base.matrix)


async def test_C15_a_jump_is_bridged_by_the_motion_before() -> None:
    sent, _ = await guarded(drive(0.1, jump=SE3.exp([0, 0, 0.6, 0.0, 0.5, 0])), "bridge")

    clean = drive(0.1)
    assert [i for i, message in enumerate(sent) if message.is_lost] == [JUMP_AT]
    for message, expected in zip(sent, clean, strict=True):
        np.testing.assert_allclose(
            message.T_odom_base.matrix, expected.T_odom_base.matrix, atol=1e-9
        )
    velocity = sent[-1].velocity_mps
    assert velocity is not None
    np.testing.assert_allclose(velocity, SE3.exp([0, 0, -0.6, 0, 0, 0]).R @ np.ones(3))


async def test_C15_a_jump_begins_a_new_mission() -> None:
    guard = OdometryGuard(OdometryGuardConfig(on_jump="split"))
    given: Channel[Odometry] = Channel("odometry", Limits(capacity=1000))
    sent: Channel[Odometry] = Channel("odometry", Limits(capacity=1000))
    for message in drive(0.1, jump=SE3.exp([0, 0, 0, 0.5, 0.0, 0])):
        await given.put(message)
    given.close()

    await guard.run(Inputs(Receiver(given)), Outputs(Sender([sent])))
    sent.close()

    receiver = Receiver(sent)
    first = [message.stamp_ns async for message in receiver]
    assert await receiver.enter_next_epoch()
    second = [message.stamp_ns async for message in receiver]
    assert (len(first), len(second)) == (JUMP_AT, 60 - JUMP_AT)


async def test_a_turn_on_the_spot_that_no_robot_makes_is_a_jump() -> None:
    sent, _ = await guarded(drive(0.1, jump=SE3.exp([0, 0, 1.0, 0, 0, 0])))

    assert [i for i, message in enumerate(sent) if message.covariance is not None] == [JUMP_AT]
    assert turn_of(sent) > 0.9


async def test_after_some_jumps_in_a_row_the_odometry_is_believed() -> None:
    """A robot that is suddenly carried at 20 m/s moves like that."""
    slow = drive(0.1, speed_mps=0.0, turn_radps=0.0)
    fast = [
        Odometry(
            stamp_ns=m.stamp_ns, T_odom_base=SE3.exp([0, 0, 0, 2.0 * max(i - JUMP_AT, 0), 0, 0])
        )
        for i, m in enumerate(slow)
    ]

    sent, found = await guarded(fast)

    assert list(found.activity.warnings.values()) == [3]
    assert all(message.covariance is None for message in sent[JUMP_AT + 4 :])


async def test_stamps_that_do_not_increase_are_lost_and_counted() -> None:
    first = Odometry(stamp_ns=5, T_odom_base=SE3.identity())

    sent, found = await guarded([first, first])

    assert len(sent) == 1
    assert found.activity.losses == {"odometry whose stamp does not increase": 1}


@settings(max_examples=15, deadline=None)
@given(
    speed_mps=st.floats(0, 12),
    turn_radps=st.floats(-2, 2),
    period_s=st.sampled_from([0.02, 0.1, 1.0]),
)
async def test_C15_plain_drives_pass_as_they_are(
    speed_mps: float, turn_radps: float, period_s: float
) -> None:
    messages = drive(period_s, speed_mps=speed_mps, turn_radps=turn_radps)

    sent, found = await guarded(messages)

    assert found.activity.warnings == {}
    assert [m.covariance for m in sent] == [None] * 60
