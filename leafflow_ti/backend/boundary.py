"""The one place where arrays of callers come in and results go out: NumPy or torch, any layout, either precision.

float32 is computed in single, float64 in double precision; so are 32-bit and longer integers, while shorter ones,
float16 and bool are exact in single precision. What cannot be computed with is an error here, in one line.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import InputError

if TYPE_CHECKING:
    from leafflow_ti.runtime import Device

Precision = Literal["f32", "f64"]
SINGLE = tuple(np.dtype(name) for name in ("float32", "float16", "bool", "uint8", "int8", "uint16", "int16"))
DOUBLE = tuple(np.dtype(name) for name in ("float64", "int32", "uint32", "int64", "uint64"))


class ArrayError(InputError, ValueError):
    """An array of the wrong shape, or an output that cannot be written."""


class ArrayTypeError(InputError, TypeError):
    """An array of a type that is not computed with."""


@dataclass(frozen=True, eq=False)
class Call:
    """One call of a public function: ``precision`` of its work, ``torch`` if its results are tensors on the device
    ``place``, and ``out`` as given."""

    precision: Precision
    torch: Any = None
    place: Any = None
    out: Any = None

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the results."""
        return np.dtype(np.float32 if self.precision == "f32" else np.float64)

    @cached_property
    def device(self) -> Device:
        """Where kernels run; the engine starts when it is first asked for."""
        from leafflow_ti.runtime import start

        return start("auto", self.precision)

    def read(self, value: Any) -> NDArray[Any]:
        """``value`` as a contiguous NumPy array of ``dtype``: the caller's own memory where it is one already."""
        return np.ascontiguousarray(_host(value), self.dtype)

    def result(self, shape: Sequence[int]) -> NDArray[Any]:
        """Where a result may be written: the memory of ``out`` if it is contiguous, else a new array. Pass it on to
        ``give``. Raises ArrayError where ``out`` has another shape or type, or is read-only."""
        target = None if self.out is None else self._checked(tuple(shape))
        if target is not None and target.flags.c_contiguous:
            return target
        return np.empty(tuple(shape), self.dtype)

    def give(self, array: Any, *, own: bool = False) -> Any:
        """The result for the caller: ``out`` with these values if it was given, else the array, as a tensor for callers
        of torch. ``own``: another result, which is never written to ``out``."""
        array = np.asarray(array, self.dtype)
        if self.out is not None and not own:
            target = self._checked(array.shape)
            if not np.may_share_memory(target, array):
                target[...] = array
            if self.torch is not None and self.out.device.type != "cpu":
                self.out.copy_(self.torch.from_numpy(target))
            return self.out
        array = np.ascontiguousarray(array)
        return array if self.torch is None else self.torch.from_numpy(array).to(self.place)

    def _checked(self, shape: tuple[int, ...]) -> NDArray[Any]:
        target = _host(self.out)
        if target.shape != shape or target.dtype != self.dtype:
            raise ArrayError(f"out is {target.dtype} of the shape {target.shape}: it must be {self.dtype} of {shape}")
        if not target.flags.writeable:
            raise ArrayError("out is read-only: give an array that can be written")
        return target


def opened(*values: Any, out: Any = None, precision: Precision | None = None) -> Call:
    """The call of a function with these arrays (None: not given). In double precision where one of them asks for it,
    unless ``precision`` is given; results are tensors where the first array is one.

    Raises ArrayTypeError for types that are not computed with.
    """
    given = [value for value in values if value is not None]
    found = [_type(value) for value in given]
    if precision is None:
        precision = "f64" if any(dtype in DOUBLE for dtype in found) else "f32"
    torch = _torch_of(given[0])
    if out is not None and (_torch_of(out) is None) != (torch is None):
        raise ArrayTypeError(f"out is a {type(out).__name__}, the input a {type(given[0]).__name__}: give both alike")
    if out is not None and torch is None and not isinstance(out, np.ndarray):
        raise ArrayTypeError(f"out is a {type(out).__name__}: it must be an array")
    return Call(precision, torch, None if torch is None else given[0].device, out)


def _torch_of(value: Any) -> Any:
    """The module torch if ``value`` is a tensor. Only who has imported it has tensors."""
    torch = sys.modules.get("torch")
    return torch if torch is not None and isinstance(value, getattr(torch, "Tensor", ())) else None


def _host(value: Any) -> NDArray[Any]:
    """As a NumPy array, of the same memory if that is on this machine."""
    if _torch_of(value) is not None:
        return np.asarray(value.detach().cpu().numpy())
    return np.asarray(value)


def _type(value: Any) -> np.dtype[Any]:
    torch = _torch_of(value)
    if torch is not None and value.dtype == torch.bfloat16:
        raise ArrayTypeError("an array of torch.bfloat16 is not computed with: convert it to float32")
    dtype = _host(value).dtype.newbyteorder("=")
    if dtype not in SINGLE + DOUBLE:
        raise ArrayTypeError(f"an array of {dtype} is not computed with: convert it to float32 or float64")
    return dtype
