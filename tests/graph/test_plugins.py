"""Operators of other packages are checked for what graphs and replays rely on."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.plugins import check_operator, fingerprint, operators_of
from mapstream.operators.operator import NoPorts, Operator, OperatorConfig, context
from mapstream.operators.samples import has_samples, samples
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.messages.sensors import LidarScan
from tests.graph.stages import STAGES

pytestmark = pytest.mark.anyio


@dataclass(frozen=True)
class Scans:
    scans: Receiver[LidarScan]


@dataclass(frozen=True)
class Clouds:
    clouds: Sender[PointCloud]


class Crop(Operator[Scans, Clouds]):
    """Keep what is near."""

    async def run(self, inputs: Scans, outputs: Clouds) -> None:
        async for scan in inputs.scans:
            near = scan.points[np.linalg.norm(scan.points, axis=1) < 4]
            await outputs.clouds.send(PointCloud(stamp_ns=scan.stamp_ns, points=near))


class Random(Operator[Scans, Clouds]):
    """Send noise."""

    async def run(self, inputs: Scans, outputs: Clouds) -> None:
        async for scan in inputs.scans:
            points = np.random.default_rng().random((3, 3), np.float32)
            await outputs.clouds.send(PointCloud(stamp_ns=scan.stamp_ns, points=points))


class WallTime(Operator[Scans, Clouds]):
    """Stamp with the wall clock."""

    async def run(self, inputs: Scans, outputs: Clouds) -> None:
        async for scan in inputs.scans:
            now_ns = time.time_ns()
            await outputs.clouds.send(PointCloud(stamp_ns=now_ns, points=scan.points))


class Clocked(Operator[Scans, Clouds]):
    """Ask the clock, though it has the stamps."""

    async def run(self, inputs: Scans, outputs: Clouds) -> None:
        async for _ in inputs.scans:
            now_ns = context().clock.now_ns()
            await outputs.clouds.send(
                PointCloud(stamp_ns=now_ns, points=np.zeros((0, 3), np.float32))
            )


class Backwards(Operator[Scans, Clouds]):
    """Send all at the end, the last first."""

    async def run(self, inputs: Scans, outputs: Clouds) -> None:
        scans = [scan async for scan in inputs.scans]
        for scan in reversed(scans):
            await outputs.clouds.send(PointCloud(stamp_ns=scan.stamp_ns, points=scan.points))


class Writer(Operator[Scans, Clouds]):
    """Write into what it gets."""

    async def run(self, inputs: Scans, outputs: Clouds) -> None:
        async for scan in inputs.scans:
            scan.points[0] = 0


class Silent(Operator[NoPorts, NoPorts]):
    async def run(self, inputs: NoPorts, outputs: NoPorts) -> None:
        return


class NeedsPath(OperatorConfig):
    path: str


class Sink(Operator[Scans, NoPorts]):
    """Write somewhere."""

    def __init__(self, config: NeedsPath) -> None:
        self._path = config.path

    async def run(self, inputs: Scans, outputs: NoPorts) -> None:
        return


async def findings(kind: type[Operator[Any, Any]]) -> list[str]:
    found = await check_operator("it", Catalogue({"it": kind}))
    return [f"{finding.level}: {finding.message}" for finding in found]


async def test_Q8_finds_nothing_wrong_with_a_good_operator() -> None:
    assert await findings(Crop) == []


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Random, "error: sends something else when it runs again"),
        (WallTime, "error: sends something else when it runs again"),
        (WallTime, "error: output 'clouds': stamps are not those of the inputs"),
        (Clocked, "error: sends something else when it runs again"),
        (Backwards, "error: output 'clouds': stamps go backwards"),
        (Writer, "error: failed on 5 small messages: ValueError: assignment destination is read"),
        (Silent, "error: has no docstring"),
        (Silent, "error: has neither inputs nor outputs"),
        (Sink, "note: not run: its config has no default for path"),
        (
            STAGES["double"],
            "note: not run: there are no samples for numbers (Number), hints (Word)",
        ),
    ],
)
async def test_Q8_finds(kind: type[Operator[Any, Any]], message: str) -> None:
    assert any(found.startswith(message) for found in await findings(kind))


async def test_Q8_operator_that_cannot_be_imported() -> None:
    found = await check_operator("nothing", Catalogue())

    assert found[0].message.startswith("no operator 'nothing'")


def test_package_that_offers_nothing() -> None:
    with pytest.raises(ConfigError, match="numpy: no installed package of this name offers"):
        operators_of("numpy")


def test_every_sample_is_fresh_equal_and_in_order() -> None:
    a, b = samples(LidarScan), samples(LidarScan)

    assert has_samples(LidarScan)
    assert fingerprint(a) == fingerprint(b)
    assert [m.stamp_ns for m in a] == sorted({m.stamp_ns for m in a})


def test_fingerprint_sees_one_bit() -> None:
    cloud = samples(PointCloud)[0]
    points = cloud.points.copy()
    points[7, 1] = np.nextafter(points[7, 1], np.float32(9))

    assert fingerprint(PointCloud(stamp_ns=cloud.stamp_ns, points=points)) != fingerprint(cloud)
