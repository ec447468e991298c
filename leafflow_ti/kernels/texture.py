"""A window's texture: how smooth it is, and how much of it could be noise."""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import Number, Region, Value

TRUSTED = 4.0
"""Most that a noise level known beforehand may exceed the residual: fine texture may pass for noise in its estimate,
but then the residual tells; a model with many columns fits a small window's noise, but not most of it."""


@functools.cache
def texture_functions(spec: KernelSpec) -> SimpleNamespace:
    """``any_cut``, ``smoothness``, ``gradient``, ``noise_variance`` and ``gradient_noise``."""
    V = spec.element
    small = dense(spec)

    @ti.func
    def any_cut(p: ti.template(), number: ti.template(), ws: ti.template()) -> ti.i32:
        """Whether a window of the group is cut."""
        return small.any_lane(ws[region(p, number, Region.CUT)] > V(0.5))

    @ti.func
    def smoothness(p: ti.template(), number: ti.template(), ws: ti.template()):
        """The factor ρ of the noise that filters leave: the share of the gradient's energy that survives one more
        smoothing.

        Where only a part of the window is seen and C is that of a whole one, the residual's variance is too small by
        it.
        """
        energy = region(p, number, Region.MOMENTS) + (number[p.n + Number.EXTRA] + 1) * p.stride
        seen, plain, smooth = ws[energy - p.stride], ws[energy], ws[energy + p.stride]
        some = plain > V(0.0)
        share = ti.select(some, ti.min(smooth / ti.select(some, plain, V(1.0)), V(1.0)), V(1.0))
        if number[p.n + Number.REWEIGHTED] == 1:
            # The same noise, by fewer or more unequal samples.
            share = share * ws[region(p, number, Region.SPREAD)]
        else:
            whole = share / ti.max(seen, V(1e-6))
            if ti.static(spec.cut):
                cut = ws[region(p, number, Region.CUT)] > V(0.5)
                whole = ti.select(cut, share * ws[region(p, number, Region.SPREAD)], whole)
            share = whole
        return share

    @ti.func
    def gradient(p: ti.template(), number: ti.template(), ws: ti.template()):
        """The tensor [xx, xy; xy, yy] of the gradient: xx, xy, yy."""
        moments, lower = region(p, number, Region.MOMENTS), p.n + Number.LOWER
        ix, iy = number[p.n + Number.FLOW_ROWS], number[p.n + Number.FLOW_ROWS + 1]
        xx = ws[moments + number[lower + tri(ix, ix)] * p.stride]
        xy = ws[moments + number[lower + tri(iy, ix)] * p.stride]
        yy = ws[moments + number[lower + tri(iy, iy)] * p.stride]
        return xx, xy, yy

    @ti.func
    def noise_variance(residual: ti.template(), p: ti.template(), value: ti.template()):
        """Image noise variance that texture must exceed: that of the residual, or the known one if it is larger."""
        return ti.max(residual, ti.min(V(value[p.v + Value.NOISE_LEVEL]), residual * TRUSTED))

    @ti.func
    def gradient_noise(residual: ti.template(), p: ti.template(), value: ti.template()):
        """Image noise variance that the gradients hold: as above, but of the residual only what noise explains.

        What the model leaves out makes residuals larger; it takes nothing away from the texture.
        """
        known = V(value[p.v + Value.NOISE_LEVEL])
        explained = ti.select(known > V(0.0), ti.min(residual, known * TRUSTED), residual)
        return ti.max(explained, ti.min(known, residual * TRUSTED))

    return SimpleNamespace(
        any_cut=any_cut, smoothness=smoothness, gradient=gradient, noise_variance=noise_variance,
        gradient_noise=gradient_noise,
    )  # fmt: skip
