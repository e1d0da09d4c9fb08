"""vision_msgs in both encodings become objects of ours."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import RawMessage
from mapstream.streams.errors import DecodeError
from mapstream.streams.messages.objects import ObjectDetections
from tests.recordings.decoding.made_ros import STAMP_NS
from tests.recordings.decoding.made_vision import Thing, detections

both = pytest.mark.parametrize("encoding", ["cdr", "ros1"])
_CUP = (("41", 0.7), ("39", 0.9), ("56", 0.1))


def decode(message: RawMessage) -> ObjectDetections:
    found = decoder_for(message.channel)(message)
    assert isinstance(found, ObjectDetections)
    return found


@both
def test_boxes_in_an_image(encoding: str) -> None:
    things = [
        Thing(_CUP, (100.0, 60.0, 0.0, 20.0, 10.0), place=(0.5, 0.25, 2.0)),
        Thing((("7", 0.5),), (50.0, 50.0, np.pi / 2, 20.0, 10.0)),
    ]

    found = decode(detections(encoding, "2D", things))

    assert (found.stamp_ns, found.frame, found.labels) == (STAMP_NS, "left", ("39", "7"))
    np.testing.assert_allclose(found.scores, [0.9, 0.5], rtol=1e-6)
    # pixels from the corner become pixels from the middle of the first
    boxes = [[89.5, 54.5, 109.5, 64.5], [44.5, 39.5, 54.5, 59.5]]
    np.testing.assert_allclose(found.boxes_px, boxes, atol=1e-4)
    assert found.centers_m is not None
    np.testing.assert_array_equal(found.centers_m, [[0.5, 0.25, 2.0], [np.nan] * 3])
    assert (found.width_px, found.height_px) == (0, 0)


@both
def test_boxes_in_space(encoding: str) -> None:
    half = float(np.sqrt(0.5))
    things = [
        Thing(_CUP, (0.1, 0.2, 3.0, 0.4, 0.5, 0.6), (0.0, 0.0, 2 * half, 2 * half)),
        Thing(_CUP, (1.0, 0.0, 2.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
    ]

    found = decode(detections(encoding, "3D", things))

    assert found.centers_m is not None
    assert found.extents_m is not None
    assert found.quats_camera_object_xyzw is not None
    np.testing.assert_allclose(found.centers_m, [[0.1, 0.2, 3.0], [1.0, 0.0, 2.0]], rtol=1e-6)
    np.testing.assert_allclose(found.extents_m, [[0.4, 0.5, 0.6], [np.nan] * 3], rtol=1e-6)
    quats = [[0.0, 0.0, half, half], [np.nan] * 4]
    np.testing.assert_allclose(found.quats_camera_object_xyzw, quats, rtol=1e-12)
    assert np.isnan(found.boxes_px).all()


def test_tracks_are_numbers_or_names_that_become_numbers() -> None:
    box = (100.0, 60.0, 0.0, 20.0, 10.0)
    names = ("12", "", "left-door", "12345678901234567890", "left-door")

    found = decode(detections("cdr", "2D", [Thing(_CUP, box, track=name) for name in names]))
    without = decode(detections("cdr", "2D", [Thing((), box)]))

    assert found.track_ids is not None
    ids = found.track_ids.tolist()
    assert (ids[0], ids[1]) == (12, -1)
    assert ids[2] == ids[4]
    assert len({*ids}) == 4
    assert min(ids[2:]) >= 0
    assert without.track_ids is None
    assert (without.labels, without.scores.tolist()) == (("",), [0.0])


@both
@pytest.mark.parametrize("dimensions", ["2D", "3D"])
def test_no_object_is_a_message_all_the_same(encoding: str, dimensions: str) -> None:
    assert len(decode(detections(encoding, dimensions, []))) == 0


@settings(max_examples=100, deadline=None)
@given(
    data=st.data(), encoding=st.sampled_from(["cdr", "ros1"]), kind=st.sampled_from(["2D", "3D"])
)
def test_damaged_messages_raise_nothing_but_decode_errors(
    data: st.DataObject, encoding: str, kind: str
) -> None:
    box = (100.0, 60.0, 0.0, 20.0, 10.0) if kind == "2D" else (1.0, 2.0, 3.0, 1.0, 1.0, 1.0)
    message = detections(encoding, kind, [Thing(_CUP, box)] * 2)
    content = bytearray(message.data)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    message.data = memoryview(bytes(content[: data.draw(st.integers(0, len(content)))]))

    with contextlib.suppress(DecodeError):
        decoder_for(message.channel)(message)
