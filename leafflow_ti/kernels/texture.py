"""How smooth a window's texture is: the factor ρ of the noise that its filters leave."""

import functools

from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import Number, Region


@functools.cache
def texture_function(spec: KernelSpec):
    """The function that reads ρ, the share of the gradient's energy that survives one more smoothing."""
    V = spec.element

    @ti.func
    def smoothness(p: ti.template(), number: ti.template(), ws: ti.template()):
        energy = region(p, number, Region.MOMENTS) + (number[p.n + Number.EXTRA] + 1) * p.stride
        plain, smooth = ws[energy], ws[energy + p.stride]
        some = plain > V(0.0)
        share = ti.select(some, ti.min(smooth / ti.select(some, plain, V(1.0)), V(1.0)), V(1.0))
        if number[p.n + Number.REWEIGHTED] == 1:
            # The same noise, by fewer or more unequal samples.
            share = share * ws[region(p, number, Region.SPREAD)]
        return share

    return smoothness
