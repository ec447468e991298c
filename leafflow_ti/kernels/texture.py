"""How smooth a window's texture is: the factor ρ of the noise that its filters leave."""

import functools

from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import Number


@functools.cache
def texture_function(spec: KernelSpec):
    """The function that reads ρ, the share of the gradient's energy that survives one more smoothing, of each lane."""
    precise, lanes = spec.precise, spec.lanes

    @ti.func
    def smoothness(pixel: ti.i32, n_pixels: ti.i32, number: ti.template(), J: ti.template()):
        rho = ti.Vector.zero(precise, lanes)
        energy = (number[Number.EXTRA] + 1) * n_pixels + pixel
        for i in range(lanes):
            plain = ti.cast(J[energy + i], precise)
            smooth = ti.cast(J[energy + n_pixels + i], precise)
            rho[i] = ti.select(plain > 0, ti.min(smooth / plain, precise(1.0)), precise(1.0))
        return rho

    return smoothness
