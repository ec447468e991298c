"""What goes in and comes out of the backend: types, layouts, tensors, outputs; what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from leafflow_ti.backend import ArrayError, ArrayTypeError, optical_flow
from leafflow_ti.backend.boundary import DOUBLE, SINGLE, opened
from leafflow_ti.errors import InputError


@pytest.mark.parametrize("dtype", [*SINGLE, *DOUBLE], ids=str)
def test_types(dtype: np.dtype[Any]) -> None:
    values = (np.arange(24).reshape(2, 3, 4) % 5).astype(dtype)
    wanted = np.float32 if dtype in SINGLE else np.float64
    for given in (values, values[:, ::-1, ::2], values.astype(dtype.newbyteorder(">"))):
        call = opened(given)
        assert call.dtype == wanted
        read = call.read(given)
        assert read.dtype == wanted
        assert read.flags.c_contiguous
        np.testing.assert_array_equal(read, given.astype(float))
        assert opened(given, precision="f32").dtype == np.float32


def test_what_is_not_computed_with() -> None:
    for values in (np.zeros(3, complex), np.zeros(3, "U3"), np.zeros(3, "M8[s]"), np.array([None])):
        with pytest.raises(ArrayTypeError, match=r"not computed with: convert") as caught:
            opened(values)
        assert isinstance(caught.value, TypeError)
        assert isinstance(caught.value, InputError)


def test_own_memory_is_read_without_a_copy() -> None:
    values = np.zeros((3, 4), np.float32)
    values.flags.writeable = False
    assert np.shares_memory(opened(values).read(values), values)


def test_outputs() -> None:
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    wide = np.zeros((3, 8), np.float32)
    for out in (np.zeros((3, 4), np.float32), wide[:, ::2], np.zeros((4, 3), np.float32).T):
        call = opened(values, out=out)
        room = call.result((3, 4))
        assert np.shares_memory(room, out) == out.flags.c_contiguous
        room[...] = 2 * values
        assert call.give(room) is out
        np.testing.assert_array_equal(out, 2 * values)
    assert not wide[:, 1::2].any()
    read_only = np.zeros((3, 4), np.float32)
    read_only.flags.writeable = False
    for bad in (np.zeros((3, 5), np.float32), np.zeros((3, 4)), read_only):
        for use in (lambda call: call.result((3, 4)), lambda call: call.give(values)):
            with pytest.raises(ArrayError, match="out is") as caught:
                use(opened(values, out=bad))
            assert isinstance(caught.value, ValueError)
    with pytest.raises(ArrayTypeError, match="list"):
        opened(values, out=[0.0])


def test_tensors() -> None:
    torch = pytest.importorskip("torch")
    values = torch.zeros((3, 4), requires_grad=True)
    call = opened(values)
    read = call.read(values)
    assert read.ctypes.data == values.data_ptr()
    given = call.give(read)
    assert isinstance(given, torch.Tensor)
    assert given.data_ptr() == values.data_ptr()
    out = torch.zeros((3, 4))
    call = opened(values, out=out)
    room = call.result((3, 4))
    assert room.ctypes.data == out.data_ptr()
    room[...] = 3.0
    assert call.give(room) is out
    assert bool((out == 3.0).all())
    with pytest.raises(ArrayTypeError, match="alike"):
        opened(values, out=np.zeros((3, 4), np.float32))
    with pytest.raises(ArrayTypeError, match="bfloat16"):
        opened(torch.zeros(3, dtype=torch.bfloat16))


def test_a_tensor_and_an_array_give_the_same_flow() -> None:
    torch = pytest.importorskip("torch")
    frames = np.random.default_rng(0).random((3, 20, 30)).astype(np.float32)
    flow, std = optical_flow(torch.from_numpy(frames), errors=True)
    wanted = optical_flow(frames)
    assert isinstance(flow, torch.Tensor)
    assert isinstance(std, torch.Tensor)
    np.testing.assert_array_equal(flow.numpy(), wanted)
