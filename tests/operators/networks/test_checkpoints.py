"""Checkpoints of PyTorch are read without it, and nothing that they say is run."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mapstream.operators.networks.checkpoints import Weights, read_checkpoint
from mapstream.streams.errors import RecordingError
from tests.operators.networks.checkpoint_files import Named, Tensor, Writer, as_legacy, as_zip

DTYPES: st.SearchStrategy[np.dtype[Any]] = st.sampled_from(
    [np.dtype(np.float32), np.dtype(np.int64), np.dtype(np.uint8)]
)
SHAPES = hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=4)
ARRAYS: st.SearchStrategy[Weights] = st.dictionaries(
    st.text("abc.", min_size=1, max_size=6), hnp.arrays(DTYPES, SHAPES, fill=st.just(1)), max_size=3
)
WRITERS = pytest.mark.parametrize("write", [as_zip, as_legacy])


@WRITERS
@given(arrays=ARRAYS)
def test_tensors_come_back_as_they_were(write: Writer, arrays: Weights) -> None:
    found = read_checkpoint(write(arrays))

    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


@WRITERS
@pytest.mark.parametrize(
    "name",
    [
        "os.system",
        "posix.mkdir",
        "builtins.eval",
        "builtins.getattr",
        "numpy.load",
        "torch.nn.modules.linear.Linear",
        "torch._utils._rebuild_parameter",
        "collections.Counter",
    ],
)
def test_other_names_are_refused_and_not_run(write: Writer, name: str, tmp_path: Path) -> None:
    trace = tmp_path / "was_run"
    module, _, attribute = name.rpartition(".")
    foreign = Named(module, attribute, (str(trace),))

    with pytest.raises(RecordingError, match=rf"names {name}, .*was not run"):
        read_checkpoint(write({"weights": foreign}))

    assert not trace.exists()


@WRITERS
@given(name=st.tuples(st.text("abctorchs._", min_size=1), st.text("FloatStorage_", min_size=1)))
def test_no_name_is_looked_up(write: Writer, name: tuple[str, str]) -> None:
    with pytest.raises(RecordingError):
        read_checkpoint(write({"weights": Named(*name)}))


@WRITERS
def test_a_tensor_stays_within_its_storage(write: Writer) -> None:
    wide = Tensor(np.zeros(4, np.float32), (3, 2), (2, 1))

    with pytest.raises(RecordingError, match="6 numbers in a storage of 4"):
        read_checkpoint(write({"weights": wide}))


@WRITERS
@given(cut=st.floats(0, 0.99), flipped=st.integers(0, 2**32))
def test_damaged_files_are_an_error_and_nothing_else(
    write: Writer, cut: float, flipped: int
) -> None:
    whole = write({"weights": np.arange(12, dtype=np.float32).reshape(3, 4)})
    bent = bytearray(whole)
    bent[flipped % len(bent)] ^= 0x55

    with pytest.raises(RecordingError):
        read_checkpoint(whole[: int(cut * len(whole))])
    with suppress(RecordingError):  # a flipped bit of a number is a number
        read_checkpoint(bytes(bent))


def test_transposed_tensors_keep_their_shape() -> None:
    numbers = np.arange(6, dtype=np.float32)

    found = read_checkpoint(as_zip({"weights": Tensor(numbers, (3, 2), (1, 3))}))

    np.testing.assert_array_equal(found["weights"], numbers.reshape(2, 3).T)


def test_dictionaries_inside_give_names_with_a_dot() -> None:
    found = read_checkpoint(as_zip({"net": {"a": np.ones(2, np.float32)}, "epoch": 3}))

    assert list(found) == ["net.a"]


def test_a_list_is_no_checkpoint() -> None:
    with pytest.raises(RecordingError, match="a list, expected named tensors"):
        read_checkpoint(as_zip([1, 2]))
