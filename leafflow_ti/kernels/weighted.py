"""Solutions of windows that are weighted anew: eigenvectors of their tensor against their noise."""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.null_space import JACOBI_SWEEPS, null_space_stages
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import Number, Region, Value


@functools.cache
def weighted_stages(spec: KernelSpec) -> SimpleNamespace:
    """The stages ``whiten``, ``unwhiten`` and ``fundamental``."""
    precise, V = spec.precise, spec.element
    small, plain = dense(spec), null_space_stages(spec)

    @ti.func
    def whiten(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """``A := L^-1 A L^-T``, ``L L^T = S N S``: ``A v = λ N v`` as an eigenproblem; ``which`` as in ``scale``."""
        n = number[p.n + Number.N]
        packed, factor = region(p, number, Region.TENSOR), region(p, number, Region.NOISE_FACTOR)
        noise, full = region(p, number, Region.WEIGHT_NOISE), region(p, number, Region.FULL)
        for r in range(n):
            for c in range(r + 1):
                scale = value[p.v + Value.SCALE + r] * value[p.v + Value.SCALE + c]
                element = ws[noise + tri(r, c) * p.stride] * scale
                if plain.left_out(r, c, p, number) == 1:
                    element = V(ti.cast(r == c, precise))
                ws[factor + tri(r, c) * p.stride] = element
        small.cholesky(ws, factor, n, -1, p.stride)
        small.unpack(ws, packed, full, n, p.stride)
        for _ in range(2):
            small.substitute(ws, factor, full, n, n, 0, 1, p.stride)
            small.transpose(ws, full, n, p.stride)
        for r in range(n):
            for c in range(r + 1):
                ws[packed + tri(r, c) * p.stride] = ws[full + (r * n + c) * p.stride]

    @ti.func
    def unwhiten(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Eigenvectors of the whitened matrix become those of the pair of matrices."""
        solution, factor = region(p, number, Region.SOLUTION), region(p, number, Region.NOISE_FACTOR)
        small.substitute(ws, factor, solution, number[p.n + Number.N], number[p.n + Number.SOLUTIONS], 1, 2, p.stride)

    @ti.func
    def fundamental(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """The eigenvectors of ``S (M - N) S`` whose eigenvalues are nearest to 0, by full Jacobi."""
        n, k = number[p.n + Number.N], number[p.n + Number.SOLUTIONS]
        moments, noise = region(p, number, Region.MOMENTS), region(p, number, Region.WEIGHT_NOISE)
        full = region(p, number, Region.FULL)
        for r in range(n):
            for c in range(n):
                one, two = ti.max(r, c), ti.min(r, c)
                element = ws[moments + number[p.n + Number.LOWER + tri(one, two)] * p.stride]
                element = element - ws[noise + tri(one, two) * p.stride]
                scale = value[p.v + Value.SCALE + r] * value[p.v + Value.SCALE + c]
                ws[full + (r * n + c) * p.stride] = element * scale
        small.jacobi(ws, full, n, JACOBI_SWEEPS, p.stride)
        for r in range(n):
            at = full + (r * n + r) * p.stride
            ws[at] = small.magnitude(ws[at])
        small.sort_eigen(ws, full, n, k, p.stride)
        plain.unsolved(p, number, ws)
        plain.keep(full + n * n * p.stride, n, V(0.0) < V(1.0), p, number, ws)

    return SimpleNamespace(whiten=whiten, unwhiten=unwhiten, fundamental=fundamental)
