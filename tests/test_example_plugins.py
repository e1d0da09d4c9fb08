"""The example plugins of OmniMapper's three roles: found by entry points, and of use together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.plugins import check_operator
from mapstream.operators.operator import Operator
from mapstream.recordings.maps.store import load_map
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch
from tests.graph.terminal import Terminal
from tests.installed import look_installed

EXAMPLE = Path(__file__).parent.parent / "examples" / "04_plugins"
PLUGINS = {"dead_reckoning": "pose", "standstill": "measurement", "pose_log": "output"}
STAND_NS, END_NS, PERIOD_NS = 3 * 10**9, 8 * 10**9, 50_000_000
WANDER_M = np.random.default_rng(1).normal(0.0, 0.003, STAND_NS // PERIOD_NS)  # per step, at rest


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site = look_installed(tmp_path / "site", EXAMPLE.rglob("pyproject.toml"))
    monkeypatch.syspath_prepend(site)


@pytest.fixture
def mapstream(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Terminal:
    monkeypatch.chdir(tmp_path)
    return Terminal(capsys)


def record(file: Path) -> Path:
    """A robot stands for 3 s, while its odometry wanders, and drives 5 m along x, while its IMU shakes."""
    rng = np.random.default_rng(7)
    steps = np.append(WANDER_M, np.full(END_NS // PERIOD_NS, 0.05))
    with McapWriter(file) as writer:
        x_m = 0.0
        for stamp_ns in range(0, END_NS + PERIOD_NS, PERIOD_NS):
            T_odom_base = SE3.from_rotation(np.eye(3), [x_m, 0.0, 0.0])
            x_m += steps[stamp_ns // PERIOD_NS]
            writer.write("/odometry", Odometry(stamp_ns=stamp_ns, T_odom_base=T_odom_base))
            shake = 0.01 if stamp_ns < STAND_NS else 0.5
            samples = ImuBatch(
                stamps_ns=stamp_ns + np.arange(10) * PERIOD_NS // 10,
                gyro_radps=rng.normal(0.0, 0.002, (10, 3)),
                accel_mps2=rng.normal([0.0, 0.0, 9.81], shake, (10, 3)),
            )
            writer.write("/imu", samples)
    return file


@pytest.mark.parametrize("name", PLUGINS)
def test_Q1_plugin_is_short_and_found_by_its_entry_point(name: str) -> None:
    files = list((EXAMPLE / PLUGINS[name] / name).glob("*.py"))

    found = Catalogue()

    assert sum(len(file.read_text().splitlines()) for file in files) <= 60
    assert issubclass(found.get(name), Operator)
    assert found.origin(name) == name.replace("_", "-")


@pytest.mark.anyio
@pytest.mark.parametrize("name", PLUGINS)
async def test_Q1_plugin_keeps_the_promises_of_an_operator(name: str) -> None:
    findings = await check_operator(name, Catalogue())

    assert not [finding for finding in findings if finding.level == "error"]


@pytest.mark.slow
def test_Q1_the_three_roles_work_in_one_graph(mapstream: Terminal, tmp_path: Path) -> None:
    """Rests take out what the odometry wandered; every optimised map reaches the output."""
    recording = record(tmp_path / "drive.mcap")

    done = mapstream("run", EXAMPLE / "graph.yaml", recording)

    assert done.code == 0, done.err
    found = load_map(tmp_path / "plugins_map")
    rests = found.edges_of("registration")
    is_standing = found.vertices.stamp_ns <= STAND_NS
    positions = found.T_map_base(np.arange(len(found.vertices)))[:, :3, 3]
    assert {found.edges.source[row] for row in rests} == {"standstill"}
    assert len(rests) == is_standing.sum() - 1
    assert np.ptp(np.cumsum(WANDER_M)) > 0.01
    assert np.ptp(positions[is_standing], axis=0).max() < 0.003
    tables = sorted((tmp_path / "plugins_map_poses").glob("*.csv"))
    last = np.loadtxt(tables[-1], delimiter=",", skiprows=1)
    assert len(tables) > 1
    np.testing.assert_allclose(last[:, 1:], positions, atol=1e-6)
