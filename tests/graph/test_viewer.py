"""The real viewer draws a run, without a window."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from rerun.experimental import ViewerClient

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


def colourful_share(client: ViewerClient, name: str, file: Path) -> float:
    """Return how much of a view is coloured; 0 while the viewer does not show it."""
    ids = [view.view_id for view in client.get_state().views if view.name == name]
    if not ids:
        return 0.0
    client.save_screenshot(str(file), view_id=ids[0])
    image = cv2.imread(str(file))
    assert image is not None
    return float(np.mean(np.ptp(image, axis=-1) > 40))


async def test_P1_P7_the_viewer_shows_the_map_and_the_operators(
    viewer_url: str, tmp_path: Path
) -> None:
    """Both views fill, and no view reports an error."""
    plan = drive_plan()
    with strict(), RerunTap(plan, SinkSpec.parse(f"connect={viewer_url}").open()) as tap:
        await run_graph(plan, taps=[tap], on_progress=tap.on_progress)
    assert not [note for note in tap.notes() if "in time" in note]
    client = ViewerClient.connect(viewer_url)
    end_s = time.monotonic() + 30  # another process: all one can do is to ask it again
    for name in ("Map", "Operators"):
        file = tmp_path / f"{name}.png"
        while colourful_share(client, name, file) < 0.0005:
            assert time.monotonic() < end_s, f"{name} stays empty: {client.get_state()}"

    reports = [report for view in client.get_state().views for report in view.reports]
    assert [report.summary for report in reports if report.severity == "error"] == []
