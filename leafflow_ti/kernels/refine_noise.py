"""Noise of the sums over a window: filtered and interpolated white noise, of which neighbouring samples share some."""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.refine_tables import SHIFTS, Scalar, Size, Value
from leafflow_ti.kernels.refine_warp import warp_functions
from leafflow_ti.kernels.spec import KernelSpec


@functools.cache
def noise_functions(spec: KernelSpec) -> SimpleNamespace:
    """``spread_noise``: a function of the window, and what correlated noise makes of it. ``noise``: their products."""
    real, precise, lanes = spec.real, spec.precise, spec.lanes
    scalars = warp_functions(spec).scalars

    @ti.func
    def spread_noise(
        slot: ti.template(), b: ti.i32, size: ti.template(), value: ti.template(), r: ti.template(), p: ti.template()
    ):
        """A function without what photometric terms take of it, weighted; and what correlated noise makes of that.

        Both are written to SCRATCH; the noise is correlated over neighbouring samples of the lattice.
        """
        s, n, across = scalars(slot, size), size[Size.SAMPLE_GROUPS] * lanes, size[Size.ACROSS]
        first = (slot.real + size[Size.FUNCTION]) * lanes
        plain = (slot.real + size[Size.SCRATCH]) * lanes + b * n
        rough = (slot.real + size[Size.SCRATCH]) * lanes + (SHIFTS + b) * n
        along_x = (slot.real + size[Size.FUNCTION]) * lanes + b * n
        reach = size[Size.NEIGHBOURS]
        for i in range(n):
            found = r[first + b * n + i]
            for m in range(size[Size.TERMS]):
                taken = ti.cast(p[s + Scalar.SOLVED + m * SHIFTS + b], real)
                found = found - taken * r[first + (SHIFTS + m) * n + i]
            r[plain + i] = found * r[(slot.real + size[Size.WEIGHT]) * lanes + i]
        # The function itself is no longer needed: its place takes the sums along x.
        for y in range(across):
            for x in range(across):
                found = ti.cast(0.0, real)
                for d in range(ti.max(0, x - reach), ti.min(across, x + reach + 1)):
                    found += r[plain + y * across + d] * ti.cast(value[Value.CORRELATION_AT + ti.abs(d - x)], real)
                r[along_x + y * across + x] = found
        for y in range(across):
            for x in range(across):
                found = ti.cast(0.0, real)
                for d in range(ti.max(0, y - reach), ti.min(across, y + reach + 1)):
                    found += r[along_x + d * across + x] * ti.cast(value[Value.CORRELATION_AT + ti.abs(d - y)], real)
                r[rough + y * across + x] = found

    @ti.func
    def noise(slot: ti.template(), i: ti.i32, size: ti.template(), r: ti.template(), p: ti.template()):
        """Row i of the noise of the functions' sums, per variance of a sample."""
        s, n = scalars(slot, size), size[Size.SAMPLE_GROUPS] * lanes
        first = (slot.real + size[Size.SCRATCH]) * lanes
        for j in range(SHIFTS):
            found = ti.cast(0.0, precise)
            for k in range(size[Size.SAMPLES]):
                found += ti.cast(r[first + i * n + k] * r[first + (SHIFTS + j) * n + k], precise)
            p[s + Scalar.NOISE + i * SHIFTS + j] = found

    return SimpleNamespace(spread_noise=spread_noise, noise=noise)
