"""The tree of frames: composition, interpolation, refusals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.streams.errors import TransformError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import TransformBatch
from mapstream.streams.transforms import TransformTree

SECOND = 1_000_000_000


def _shift(x_m: float, yaw_rad: float = 0.0) -> SE3:
    return SE3.exp([0, 0, yaw_rad, x_m, 0, 0])


def _robot() -> TransformTree:
    """Return odom -> base (sampled) -> mast (static) -> camera (static), base -> lidar (static)."""
    tree = TransformTree()
    for i in range(3):
        tree.add_sample("odom", "base", i * SECOND, _shift(2.0 * i, 0.5 * i))
    tree.add_static("base", "mast", _shift(0.2))
    tree.add_static("mast", "camera", SE3.exp([0.3, 0, 0, 0, 0, 1]))
    tree.add_static("base", "lidar", SE3.exp([0, 0, 1.0, 0, 0.5, 0]))
    return tree


@given(st.integers(0, 2 * SECOND), st.sampled_from(["odom", "base", "mast", "camera", "lidar"]))
def test_look_ups_compose_and_invert(stamp_ns: int, middle: str) -> None:
    tree = _robot()

    T_camera_lidar = tree.look_up("camera", "lidar", stamp_ns)
    through = tree.look_up("camera", middle, stamp_ns) @ tree.look_up(middle, "lidar", stamp_ns)

    np.testing.assert_allclose(through.matrix, T_camera_lidar.matrix, atol=1e-12)
    back = tree.look_up("lidar", "camera", stamp_ns) @ T_camera_lidar
    np.testing.assert_allclose(back.matrix, np.eye(4), atol=1e-12)


def test_samples_are_interpolated() -> None:
    T_odom_base = _robot().look_up("odom", "base", SECOND // 2)

    expected = _shift(0).interpolate(_shift(2.0, 0.5), 0.5)
    np.testing.assert_allclose(T_odom_base.matrix, expected.matrix, atol=1e-12)


def test_static_frames_need_no_stamp_that_is_known() -> None:
    tree = _robot()

    np.testing.assert_allclose(tree.look_up("base", "mast", 99 * SECOND).t, [0.2, 0, 0])
    np.testing.assert_allclose(tree.look_up("camera", "camera", -5).matrix, np.eye(4))


def test_A19_a_function_is_asked_at_each_stamp() -> None:
    asked = []

    def pan(stamp_ns: int) -> SE3:
        asked.append(stamp_ns)
        return SE3.exp([0, 0, stamp_ns / SECOND, 0, 0, 0])

    tree = TransformTree()
    tree.add_static("base", "mast", _shift(0.2))
    tree.add_function("mast", "camera", pan)

    for i in range(3):
        T_base_camera = tree.look_up("base", "camera", i * SECOND)
        np.testing.assert_allclose(T_base_camera.log()[:3], [0, 0, i], atol=1e-12)
    assert asked == [0, SECOND, 2 * SECOND]


def test_A19_batches_from_tf_and_tf_static_fill_the_tree() -> None:
    tree = TransformTree()
    tree.add(
        TransformBatch(
            stamps_ns=np.array([0]),
            parents=("base",),
            children=("lidar",),
            T_parent_child=_shift(0.5).matrix[None],
            is_static=True,
        )
    )
    tree.add(
        TransformBatch(
            stamps_ns=np.array([0, SECOND]),
            parents=("odom", "odom"),
            children=("base", "base"),
            T_parent_child=np.stack([_shift(0).matrix, _shift(1).matrix]),
        )
    )

    assert tree.frames == ["base", "lidar", "odom"]
    assert tree.parent_of("lidar") == "base"
    assert tree.parent_of("odom") is None
    np.testing.assert_allclose(tree.look_up("odom", "lidar", SECOND // 4).t, [0.75, 0, 0])


@pytest.mark.parametrize(
    ("stamp_ns", "message"),
    [
        (
            -SECOND // 2,
            "base in odom: -500000000 ns is 0.500 s before what is known, 0 to 2000000000",
        ),
        (5 * SECOND, "base in odom: 5000000000 ns is 3.000 s after what is known"),
    ],
)
def test_nothing_is_extrapolated(stamp_ns: int, message: str) -> None:
    with pytest.raises(TransformError, match=message):
        _robot().look_up("odom", "camera", stamp_ns)


def test_an_unknown_frame_names_the_known_ones() -> None:
    with pytest.raises(
        TransformError, match="no frame 'imu'; known: base, camera, lidar, mast, odom"
    ):
        _robot().look_up("base", "imu", 0)
    with pytest.raises(TransformError, match="no frame 'imu'; known: none at all"):
        TransformTree().look_up("imu", "imu", 0)


def test_frames_that_are_not_connected_name_their_roots() -> None:
    tree = _robot()
    tree.add_static("map", "marker", _shift(1))

    with pytest.raises(TransformError, match="camera hangs on odom, marker on map"):
        tree.look_up("camera", "marker", 0)


def test_cycles_double_parents_and_changes_of_kind_are_refused() -> None:
    tree = _robot()
    with pytest.raises(TransformError, match="odom in camera: camera itself hangs on odom"):
        tree.add_static("camera", "odom", _shift(1))
    with pytest.raises(TransformError, match="base in base: base itself hangs on base"):
        TransformTree().add_static("base", "base", _shift(1))
    with pytest.raises(TransformError, match="lidar hangs on base and cannot hang on mast too"):
        tree.add_sample("mast", "lidar", 0, _shift(1))
    with pytest.raises(TransformError, match="lidar in base is static already"):
        tree.add_sample("base", "lidar", 0, _shift(1))
    with pytest.raises(TransformError, match=r"mast in base: was static at .*, is now"):
        tree.add_static("base", "mast", _shift(0.3))
    tree.add_static("base", "mast", _shift(0.2))  # the same again


@given(st.permutations(range(6)))
def test_samples_may_come_in_any_order_and_the_newest_word_counts(order: list[int]) -> None:
    tree = TransformTree()
    tree.add_sample("odom", "base", 2, _shift(99))
    for i in order:
        tree.add_sample("odom", "base", i, _shift(i))

    for i in range(11):
        assert tree.look_up("odom", "base", i // 2).t[0] == i // 2


def test_old_samples_can_be_forgotten() -> None:
    tree = _robot()
    tree.forget_before(SECOND + 1)

    kept = tree.look_up("odom", "base", SECOND + 1)
    np.testing.assert_array_equal(kept.matrix, _robot().look_up("odom", "base", SECOND + 1).matrix)
    with pytest.raises(TransformError, match="before what is known"):
        tree.look_up("odom", "base", SECOND - 1)
