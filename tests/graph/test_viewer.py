"""The real viewer draws a run, without a window."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from rerun.experimental import ViewerClient, ViewerState

from mapstream.graph.run import run_graph
from mapstream.graph.tap import RerunTap
from mapstream.graph.tap_sinks import SinkSpec, spawn_viewer, wait_until_listening
from tests.graph.picture_stages import drive_plan
from tests.graph.rrd import strict, unused_url

pytestmark = [pytest.mark.anyio, pytest.mark.viewer, pytest.mark.slow]


def has_vulkan() -> bool:
    places = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))
    return any(place.is_dir() and any(place.glob("*.json")) for place in places)


@pytest.fixture
def viewer_url() -> Iterator[str]:
    if not has_vulkan():
        pytest.skip("no Vulkan driver (apt install mesa-vulkan-drivers libvulkan1)")
    url = unused_url()
    viewer = spawn_viewer(url, "--headless")
    try:
        assert wait_until_listening(url)
        yield url
    finally:
        viewer.kill()
        viewer.wait()


def shown_state(client: ViewerClient) -> ViewerState:
    """Return the viewer's state once it shows the run; another process, so it must be asked again."""
    end_s = time.monotonic() + 30
    while not {"Map", "Operators"} <= {view.name for view in client.get_state().views}:
        assert time.monotonic() < end_s, client.get_state()
    return client.get_state()


async def test_P1_P7_the_viewer_shows_the_map_and_the_operators(
    viewer_url: str, tmp_path: Path
) -> None:
    """No view reports an error, and the picture is not empty."""
    plan = drive_plan()
    with strict(), RerunTap(plan, SinkSpec.parse(f"connect={viewer_url}").open()) as tap:
        await run_graph(plan, taps=[tap], on_progress=tap.on_progress)
    client = ViewerClient.connect(viewer_url)
    state = shown_state(client)
    shot = tmp_path / "shot.png"
    client.save_screenshot(str(shot))

    errors = [r.summary for v in state.views for r in v.reports if r.severity == "error"]
    assert errors == []
    assert {"Map", "Operators"} <= {view.name for view in state.views}
    image = cv2.imread(str(shot))
    assert image is not None
    assert np.ptp(image) > 200
