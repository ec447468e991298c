"""What a window's texture does not determine: the covariance says so, and the solution is kept from harm.

A direction of the flow parameters along which J_ff holds hardly more than noise is not determined: stripes hide the
flow along them. Total least squares then takes any mixture of the solution and that direction, whose size spoils the
parameters that are determined, too; and noise propagated through J_ff^-1 knows nothing of what the data do not hold.

Noise is that of the images: what a model leaves out makes residuals larger and takes no texture away. Total least
squares mixes directions that hold less than the residual all the same: there the solution is a regularised one, too.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.texture import texture_functions
from leafflow_ti.kernels.workspace import Number, Region, Value

REPEATS = 3
"""Of the regularised solution: determined directions lose all but a thousandth of the noise's bias, others hardly
begin to grow."""


@functools.cache
def identify_functions(spec: KernelSpec) -> SimpleNamespace:
    """``admit``, and ``at_centre``, which makes parameters values at the window's centre."""
    V = spec.element
    small, texture = dense(spec), texture_functions(spec)

    @ti.func
    def quietest(p: ti.template(), number: ti.template(), ws: ti.template()):
        """The least residual variance of all solutions."""
        variance = region(p, number, Region.VARIANCE)
        least = ws[variance]
        for j in range(1, number[p.n + Number.SOLUTIONS]):
            least = ti.min(least, ws[variance + j * p.stride])
        # Nothing to take off where nothing was found: what is not a number must not spread.
        return ti.select(least > V(0.0), least, V(0.0))

    @ti.func
    def at_centre(parameters: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Parameters at the window's centre, as at a place that stands still: constants where centred squares are not
        0, derivatives along time without what the shift of the images made of those along x and y."""
        for term in range(number[p.n + Number.CENTRE_TERMS]):
            at = parameters + number[p.n + Number.CENTRE + 2 * term] * p.stride
            other = parameters + number[p.n + Number.CENTRE + 2 * term + 1] * p.stride
            ws[at] = ws[at] + ws[other] * value[p.v + Value.CENTRE + term]

    @ti.func
    def ignorance(
        response: ti.i32, rows_at: ti.i32, n_rows: ti.i32, level: ti.template(), p: ti.template(),
        number: ti.template(), value: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """Factor β of ``β E^T J_ff^-2 E``, what the rows may be off where a row is not determined; 0 where all are.

        ``level``: variance of the image noise that texture must exceed.

        In scaled columns a displacement of 1 px by any parameter is as long as ``GAIN^1/2``. With UNKNOWN σ² over the
        information along a direction, squared, it counts there as 1 px of unknown size and next to nothing elsewhere.
        """
        xx, _, yy = texture.gradient(p, number, ws)
        gain, flow = value[p.v + Value.GAIN], number[p.n + Number.FLOW]
        noise = ti.max(level, (xx + yy) * (0.5 * value[p.v + Value.LEAST_SHARE] / gain))
        scale = noise * value[p.v + Value.UNKNOWN]
        largest = V(0.0)
        for c in range(n_rows):
            at, s = response + c * p.stride, value[p.v + Value.SCALE + number[p.n + rows_at + c]]
            square = small.dot(ws, at, n_rows, at, n_rows, flow, p.stride)
            largest = ti.max(largest, square * (1.0 / (s * s)))
        factor = scale * scale
        return ti.select(largest * factor > V(1.0), factor * gain, V(0.0))

    @ti.func
    def regularised(p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()) -> ti.i32:
        """Solution ``which`` without the part that the texture does not determine; where its parameters begin.

        Repeated steps with the factor of J_ff, noise and all, towards the solution of J_ff without its noise.
        """
        flow, moments = number[p.n + Number.FLOW], region(p, number, Region.MOMENTS)
        factor, x = region(p, number, Region.FULL), region(p, number, Region.FULL_VECTORS)
        rest = x + flow * p.stride
        for r in range(flow):
            for c in range(r + 1):
                s = value[p.v + Value.SCALE + r] * value[p.v + Value.SCALE + c]
                ws[factor + tri(r, c) * p.stride] = ws[moments + number[p.n + Number.LOWER + tri(r, c)] * p.stride] * s
        small.cholesky(ws, factor, flow, -1, p.stride)
        small.clear(ws, x, flow, p.stride)
        noise = texture.gradient_noise(quietest(p, number, ws), p, value) * value[p.v + Value.DENOISE]
        for _ in range(REPEATS):
            for r in range(flow):
                s = value[p.v + Value.SCALE + r]
                total = ws[x + r * p.stride] * noise * (value[p.v + Value.NOISE + r] * s * s)
                for c in range(flow + 1):
                    column, other = c, V(1.0)
                    if c == flow:
                        column = flow + p.which
                    else:
                        other = ws[x + c * p.stride] * value[p.v + Value.SCALE + c]
                    at = tri(ti.max(r, column), ti.min(r, column))
                    total = total - ws[moments + number[p.n + Number.LOWER + at] * p.stride] * other * s
                ws[rest + r * p.stride] = total
            small.solve(ws, factor, rest, flow, 1, p.stride)
            for r in range(flow):
                ws[x + r * p.stride] = ws[x + r * p.stride] + ws[rest + r * p.stride]
        for r in range(flow):
            ws[x + r * p.stride] = ws[x + r * p.stride] * value[p.v + Value.SCALE + r]
        at_centre(x, p, number, value, ws)
        return x

    @ti.func
    def admit(
        response: ti.i32, rows_at: ti.i32, n_rows: ti.i32, cov: ti.i32, p: ti.template(), number: ti.template(),
        value: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """Where a row of solution ``which`` is not determined: add what is not known to the packed covariance at
        ``cov``, and take the regularised solution. ``response``: ``J_ff^-1 E`` [F, n_rows]."""
        residual = quietest(p, number, ws)
        held = texture.gradient_noise(residual, p, value)
        factor = ignorance(response, rows_at, n_rows, held, p, number, value, ws)
        # Total least squares mixes a direction that holds less than the residual, whatever that is made of.
        mixed = texture.noise_variance(residual, p, value)
        lost = ignorance(response, rows_at, n_rows, mixed, p, number, value, ws) > V(0.0)
        if small.any_lane(lost) == 1:
            flow = number[p.n + Number.FLOW]
            for r in range(n_rows):
                for c in range(r + 1):
                    one, two, at = response + r * p.stride, response + c * p.stride, cov + tri(r, c) * p.stride
                    unknown = small.dot(ws, one, n_rows, two, n_rows, flow, p.stride) * factor
                    ws[at] = ti.select(lost, ws[at] + unknown, ws[at])
            found = regularised(p, number, value, ws)
            target = region(p, number, Region.PARAMETERS) + p.which * flow * p.stride
            for r in range(flow):
                at = target + r * p.stride
                ws[at] = ti.select(lost, ws[found + r * p.stride], ws[at])

    return SimpleNamespace(admit=admit, at_centre=at_centre, quietest=quietest)
