"""Every message class goes through its protobuf form unchanged."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.recordings import message_codec
from mapstream.recordings.decoding import decoder_for, message_type_of
from mapstream.recordings.message_codec import decoder, encode, known_messages
from mapstream.recordings.message_schema import message_class, schema_name, schema_of
from mapstream.recordings.recording import Channel, RawMessage
from mapstream.streams.errors import DecodeError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.messages.sensors import WheelOdometry
from tests.recordings.made_messages import Beacon, Detection, one_of_each


def assert_same(a: Any, b: Any) -> None:  # noqa: ANN401
    """Compare messages by content and by the types of their arrays."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, SE3):
        np.testing.assert_array_equal(a.matrix, b.matrix)
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    elif is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    else:
        assert a == b or (a != a and b != b)  # noqa: PLR0124  # nan


def _channel(cls: type) -> Channel:
    return Channel(
        topic="/x",
        message_encoding="protobuf",
        schema_name=schema_name(cls),
        schema_encoding="protobuf",
        schema_data=schema_of(cls),
    )


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_message_round_trips_without_loss(seed: int) -> None:
    for message in one_of_each(seed):
        channel = _channel(type(message))
        decode = decoder_for(channel)

        again = decode(RawMessage(channel, 0, 0, 0, memoryview(encode(message))))

        assert decode.message_type is type(message)
        assert_same(message, again)
        assert encode(again) == encode(message), "equal messages have equal bytes"


def test_the_examples_cover_every_message_class() -> None:
    parts = {"LandmarkRef", "LoopCandidate", "OuterFrame", "RangeImageCalibration"}
    parts |= {"RecordRef", "Splice"}  # only inside others

    assert {type(m).__name__ for m in one_of_each(0)} == set(known_messages()) - parts


def test_the_schema_describes_everything_that_is_inside() -> None:
    (file,) = FileDescriptorSet.FromString(schema_of(WheelOdometry)).file

    assert file.package == "mapstream"
    assert [message.name for message in file.message_type] == [
        "WheelOdometry",
        "Transform",
        "Array",
    ]
    assert [field.name for field in file.message_type[0].field] == [
        field.name for field in fields(WheelOdometry)
    ]


def test_messages_of_other_packages_round_trip(monkeypatch: pytest.MonkeyPatch) -> None:
    known = known_messages() | {"Beacon": Beacon}
    monkeypatch.setattr(message_codec, "known_messages", lambda: known)
    beacon = Beacon(stamp_ns=5, label="tree", ranges=(1.5, 2.5), is_near=True, raw=b"\x00\xff")

    cls, decode = decoder("mapstream.Beacon", schema_of(Beacon))

    assert cls is Beacon
    assert decode(memoryview(encode(beacon))) == beacon


def test_an_unknown_class_is_a_decode_error_not_an_import() -> None:
    channel = _channel(Beacon)

    with pytest.raises(
        DecodeError, match=r"schema mapstream.Beacon: no such message; known: CameraCalibration"
    ):
        decoder_for(channel)
    assert message_type_of(channel) is None


def test_a_field_without_a_place_is_named() -> None:
    with pytest.raises(TypeError, match=r"Detection.scores: no way to write dict"):
        schema_of(Detection)


def test_an_older_file_reads_where_new_fields_have_defaults() -> None:
    """A field that the schema in the file lacks takes its default; one without a default is named."""
    described = FileDescriptorSet.FromString(schema_of(PointCloud))
    (file,) = described.file
    del file.message_type[0].field[2]  # intensity
    del file.message_type[0].oneof_decl[:]
    cloud = PointCloud(stamp_ns=1, points=np.ones((2, 3), np.float32))

    _, decode = decoder("mapstream.PointCloud", described.SerializeToString())
    assert_same(decode(memoryview(encode(cloud))), cloud)

    del file.message_type[0].field[1]
    channel = Channel(
        topic="/x", message_encoding="protobuf", schema_name="mapstream.PointCloud",
        schema_encoding="protobuf", schema_data=described.SerializeToString(),
    )  # fmt: skip
    with pytest.raises(
        DecodeError, match=r"PointCloud.points is missing: written by another version"
    ):
        decoder_for(channel)(RawMessage(channel, 0, 0, 0, memoryview(encode(cloud))))


@pytest.mark.parametrize(
    ("dtype", "shape", "reason"),
    [("O", [1, 3], "an array of dtype 'O'"), ("<f4", [7, 3], "reshape"), ("what", [1], "what")],
)
def test_arrays_that_lie_are_decode_errors(dtype: str, shape: list[int], reason: str) -> None:
    channel = _channel(PointCloud)
    made = message_class("mapstream.PointCloud", schema_of(PointCloud))()
    made.points.dtype, made.points.data = dtype, bytes(12)
    made.points.shape.extend(shape)

    with pytest.raises(DecodeError, match=reason):
        decoder_for(channel)(RawMessage(channel, 0, 0, 0, memoryview(made.SerializeToString())))


def test_a_damaged_schema_is_a_decode_error() -> None:
    channel = Channel(
        topic="/x", message_encoding="protobuf", schema_name="mapstream.Odometry",
        schema_encoding="protobuf", schema_data=b"\xff\x00nonsense",
    )  # fmt: skip

    with pytest.raises(DecodeError, match=r"mapstream.Odometry: its descriptor is damaged"):
        decoder_for(channel)
