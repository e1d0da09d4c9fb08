"""Inputs of other programs: the writers of the page work, and what is wrong with a message is said."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.diagnosis import diagnose
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import open_recording
from mapstream.streams import (
    SE3,
    Constraint,
    ImageFeatures,
    LandmarkRef,
    LoopClosure,
    ObjectDetections,
    Odometry,
)
from mapstream.streams.messages.sensors import Message

DOCS = Path(__file__).parent.parent / "docs"
TEXT = "".join((DOCS / page).read_text() for page in ("inputs.md", "objects.md"))
WRITERS = {
    name: body
    for body in re.findall(r"^```python\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
    for name in re.findall(r"python write_(\w+)\.py", body)
}
KINDS = {
    "odometry": Odometry,
    "loops": LoopClosure,
    "positions": Constraint,
    "features": ImageFeatures,
    "tracks": ImageFeatures,
    "points": ImageFeatures,
    "objects": ObjectDetections,
}
TIGHT = np.diag([1e-4] * 6)
NOWHERE = SE3.identity()


def described(file: Path, *messages: Message) -> list[str]:
    with McapWriter(file) as writer:
        for message in messages:
            writer.write("/input", message)
    with open_recording(file) as recording:
        found = diagnose(recording)
    return [finding.text for finding in found.findings if finding.name == "rejected_input"]


@pytest.mark.parametrize("name", KINDS)
def test_S9_each_input_has_a_writer_of_twenty_lines_that_works(name: str, tmp_path: Path) -> None:
    """Lines of code, less imports and the docstring; the doctor finds nothing wrong."""
    body = WRITERS[name]
    code = [
        line
        for line in body.splitlines()
        if line and not line.startswith(('"""', "import", "from"))
    ]
    file = tmp_path / f"{name}.mcap"

    subprocess.run([sys.executable, "-c", body, str(file)], check=True)

    assert len(code) <= 20
    with open_recording(file) as recording:
        (topic,) = recording.topics.values()
        assert decoder_for(topic.channel).message_type is KINDS[name]
        found = diagnose(recording)
    assert found.is_clean, found.findings


def odometry(**fields: Any) -> Odometry:  # noqa: ANN401  # made up
    made: dict[str, Any] = {"stamp_ns": 5, "T_odom_base": NOWHERE}
    return Odometry(**(made | fields))


def constraint(**fields: Any) -> Constraint:  # noqa: ANN401
    made: dict[str, Any] = {"stamp_ns": 5, "kind": "position", "covariance": TIGHT}
    return Constraint(**(made | fields))


def loop(**fields: Any) -> LoopClosure:  # noqa: ANN401
    made: dict[str, Any] = {"robot_a": "a", "stamp_a_ns": 5, "robot_b": "a", "stamp_b_ns": 3}
    return LoopClosure(**(made | {"T_a_b": NOWHERE, "covariance": TIGHT} | fields))


def features(**fields: Any) -> ImageFeatures:  # noqa: ANN401
    made: dict[str, Any] = {"stamp_ns": 5, "kind": "orb", "frame": "cam0"}
    made |= {"keypoints_px": np.zeros((2, 2), np.float32)}
    return ImageFeatures(**(made | {"descriptors": np.zeros((2, 32), np.uint8)} | fields))


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (odometry(covariance=np.zeros((6, 6))), "its covariance is not positive definite"),
        (odometry(covariance=np.triu(np.ones((6, 6)))), "its covariance is not symmetric"),
        (odometry(covariance=np.full((6, 6), np.nan)), "its covariance is not finite"),
        (odometry(velocity_mps=np.full(3, np.nan)), "velocity_mps is not finite; leave it out"),
        (
            constraint(covariance=np.diag([np.inf] * 6)),
            "a position whose covariance says that nothing",
        ),
        (constraint(kind="plane"), "a plane without `landmark`"),
        (constraint(payload=b"{"), "its payload is no JSON"),
        (loop(quality=float("nan")), "its quality is nan"),
        (loop(stamp_b_ns=0), "a stamp is zero or below"),
        (loop(stamp_b_ns=5), "both its ends are one instant"),
        (loop(covariance=np.diag([np.inf] * 6)), "its covariance is infinite, but a loop"),
        (features(kind=""), "no `kind`"),
        (
            features(descriptors=np.zeros((2, 8))),
            "descriptors are uint8 bits or float32, not float64",
        ),
        (features(keypoints_px=np.full((2, 2), np.nan, np.float32)), "keypoints are not finite"),
        (features(descriptors=np.full((2, 8), np.nan, np.float32)), "descriptors are not finite"),
        (features(frame=""), "no `frame`; it names the camera"),
        (
            features(keypoints_px=np.full((10, 2), 0.3, np.float32), descriptors=np.empty((10, 0))),
            "keypoints are pixels, these look normalised",
        ),
        (features(track_ids=np.array([4, 4])), "a track id comes twice in one image"),
        (features(track_ids=np.array([-5, -1])), "track ids are not negative, but for -1"),
        (features(points_m=np.array([[1, 2, np.nan], [1, 2, 3]])), "points_m are whole, or NaN"),
        (features(sigmas_px=np.zeros(2)), "sigmas_px are finite and positive; zeros would mean"),
        (
            features(points_m=np.ones((2, 3)), point_sigmas_m=np.array([0.1, np.inf])),
            "point_sigmas_m are finite and positive",
        ),
        (features(offsets_ns=np.array([0, 2 * 10**9])), "offsets_ns count from stamp_ns"),
    ],
)
def test_U2_the_doctor_explains_every_rejected_message(
    message: Message, reason: str, tmp_path: Path
) -> None:
    (text,) = described(tmp_path / "input.mcap", message)

    assert text.startswith(f"1 messages: {reason}")
    assert text.endswith("; the first at 5 ns")


def test_U2_reasons_are_counted_and_good_messages_pass(tmp_path: Path) -> None:
    good = [
        odometry(stamp_ns=1),
        odometry(stamp_ns=2, covariance=np.diag([np.inf, *[1.0] * 5])),
        odometry(stamp_ns=3, T_odom_base=SE3.from_rotation(np.eye(3), [99, 0, 0])),
        odometry(stamp_ns=4, T_odom_base=NOWHERE),
    ]

    assert described(tmp_path / "jumps.mcap", *good) == [
        "2 messages: the pose moves by more than 20 m in one message; the first at 3 ns"
    ]
    seen = constraint(kind="landmark", landmark=LandmarkRef(name="door"), payload=b"{}")
    assert described(tmp_path / "good.mcap", seen) == []
