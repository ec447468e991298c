"""Windows that a mask or a border cuts: what is known beforehand of whole ones, from the moments of their valid part.

With v = 1 for valid samples, ``W_e = Σ w v Δ^e``: the noise covariance of the columns is a sum of these (2.24), no
longer diagonal; that of the normal equations' noise, a sum over w², follows from the moments of w² and w;
and the second-order part of the flow of a moving plane, which the affine fit takes for its parameters, is projected on
1, x, y over what is seen. The lists are those of ``stages.mask_moments``.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import planes_loader, region
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import Number, Region, Value

XX, XXX = 3, 6
"""Where the moments of second and of third degree in x and y begin among the plain ones, behind 1, x, y."""


@functools.cache
def cut_stages(spec: KernelSpec) -> SimpleNamespace:
    """The stage ``cut_windows``; ``equation_noise`` and ``of_image_square`` for that of the covariances."""
    precise, V = spec.precise, spec.element
    small, load_planes = dense(spec), planes_loader(spec)

    @ti.func
    def noise(cut: ti.template(), p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """WEIGHT_NOISE: the noise covariance of the columns, where the window is whole its diagonal C."""
        n, target = number[p.n + Number.N], region(p, number, Region.WEIGHT_NOISE)
        lists, factors = p.n + number[p.n + Number.CUT_LISTS], p.v + number[p.n + Number.CUT_VALUES]
        for r in range(n):
            for c in range(r + 1):
                whole = V(ti.select(r == c, value[p.v + Value.NOISE + r], precise(0.0)))
                ws[target + tri(r, c) * p.stride] = ti.select(cut, V(0.0), whole)
        for e in range(number[p.n + Number.CUT_NOISES]):
            at = target + tri(number[lists + 3 * e], number[lists + 3 * e + 1]) * p.stride
            moment = ws[region(p, number, Region.MASK) + number[lists + 3 * e + 2] * p.stride]
            ws[at] = ws[at] + ti.select(cut, moment * value[factors + e], V(0.0))

    @ti.func
    def shapes(cut: ti.template(), p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """CUT_SHAPE: X [shapes, shapes] with ``X^T W X = W2``, the shapes' products over the window with the weights w
        and w², relative to X of the constant; of that, squared and relative to the whole window's, SPREAD."""
        n, mask = number[p.n + Number.SHAPES], region(p, number, Region.MASK)
        lists = p.n + number[p.n + Number.CUT_LISTS] + 3 * number[p.n + Number.CUT_NOISES]
        factors = p.v + number[p.n + Number.CUT_VALUES] + number[p.n + Number.CUT_NOISES]
        plain, squared = region(p, number, Region.CUT_PRODUCTS), region(p, number, Region.CUT_SQUARED)
        target, size, terms = region(p, number, Region.CUT_SHAPE), tri(n, 0), number[p.n + Number.CUT_PRODUCTS]
        small.clear(ws, plain, size, p.stride)
        small.clear(ws, squared, size, p.stride)
        for e in range(terms):
            at, one, two = number[lists + 3 * e], number[lists + 3 * e + 1], number[lists + 3 * e + 2]
            factor = value[factors + e]
            ws[plain + at * p.stride] = ws[plain + at * p.stride] + ws[mask + one * p.stride] * factor
            ws[squared + at * p.stride] = ws[squared + at * p.stride] + ws[mask + two * p.stride] * factor
        for which in range(2):
            small.cholesky(ws, ti.select(which == 0, plain, squared), n, -1, p.stride)
        # W = L L^T, W2 = M M^T: X = L^-T M^T. Factors hold the inverses of their diagonals.
        for r in range(n):
            for c in range(n):
                element = V(0.0)
                if c > r:
                    element = ws[squared + tri(c, r) * p.stride]
                elif c == r:
                    element = 1.0 / ws[squared + tri(r, r) * p.stride]
                ws[target + (r * n + c) * p.stride] = element
        small.substitute(ws, plain, target, n, n, 1, 2, p.stride)
        first = ws[target]
        ws[region(p, number, Region.SPREAD)] = first * first / value[factors + terms]
        for e in range(n * n):
            unit = V(ti.cast(e % (n + 1) == 0, precise))
            ws[target + e * p.stride] = ti.select(cut, ws[target + e * p.stride] / first, unit)

    @ti.func
    def equation_noise(
        target: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """Put the noise of the normal equations of solution ``which``, packed at ``target``, in the cut windows of the
        group: ``(B J_ff B^T) ∘ K'``, B being X^T among the columns of one family and K' what cameras and frames add.

        Where the texture is as strong all over the window, that is the sum over w².
        """
        flow, n, half = number[p.n + Number.FLOW], number[p.n + Number.SHAPES], region(p, number, Region.FULL)
        columns = p.n + number[p.n + Number.CUT_LISTS] + 3 * number[p.n + Number.CUT_NOISES]
        columns += 3 * number[p.n + Number.CUT_PRODUCTS]
        whole = p.v + number[p.n + Number.CUT_VALUES] + number[p.n + Number.CUT_NOISES]
        whole += number[p.n + Number.CUT_PRODUCTS] + 1
        moments, turn = region(p, number, Region.MOMENTS), region(p, number, Region.CUT_SHAPE)
        ratios = p.v + Value.RATIO + p.which * tri(flow, 0)
        cut = ws[region(p, number, Region.CUT)] > V(0.5)
        for part in range(2):
            for r in range(flow):
                for c in range(ti.select(part == 0, flow, r + 1)):
                    # Column c of J, then row r of the half-turned matrix.
                    mine = ti.select(part == 0, r, c)
                    total = V(0.0)
                    for a in range(flow):
                        if number[columns + 2 * a + 1] == number[columns + 2 * mine + 1]:
                            at = half + (r * flow + a) * p.stride
                            element = V(0.0)
                            if part == 0:
                                at = moments + number[p.n + Number.LOWER + tri(ti.max(a, c), ti.min(a, c))] * p.stride
                                element = ws[at]
                            else:
                                element = ws[at]
                            one, two = number[columns + 2 * a], number[columns + 2 * mine]
                            total = total + element * ws[turn + (one * n + two) * p.stride]
                    if part == 0:
                        ws[half + (r * flow + c) * p.stride] = total
                    else:
                        one, two = number[columns + 2 * r], number[columns + 2 * c]
                        s = value[p.v + Value.SCALE + r] * value[p.v + Value.SCALE + c]
                        s *= value[ratios + tri(r, c)] * value[whole + tri(ti.max(one, two), ti.min(one, two))]
                        at = target + tri(r, c) * p.stride
                        ws[at] = ti.select(cut, total * s, ws[at])

    @ti.func
    def of_image_square(term: ti.i32, p: ti.template(), number: ti.template()) -> ti.i32:
        """Whether a term that centred squares add to the noise is of squares of x or y: cut windows have none."""
        lists = p.n + number[p.n + Number.CUT_LISTS] + 3 * number[p.n + Number.CUT_NOISES]
        lists += 3 * number[p.n + Number.CUT_PRODUCTS] + 2 * number[p.n + Number.FLOW]
        return number[lists + term]

    @ti.func
    def curved(cut: ti.template(), p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """CURVED: x², xy, y² projected on 1, x, y over the window; CENTROID: of the window."""
        mask, factor = region(p, number, Region.MASK), region(p, number, Region.CURVED_FACTOR)
        target, basis = region(p, number, Region.CURVED), number[p.n + Number.CURVED_BASIS]
        small.clear(ws, target, 9, p.stride)
        for r in range(basis):
            for c in range(r + 1):
                at = r
                if c > 0:
                    at = XX + r + c - 2
                ws[factor + tri(r, c) * p.stride] = ws[mask + at * p.stride]
        for r in range(basis):
            for f in range(3):
                # Row r times x^(2 - f) y^f: in the list of its degree as many places behind the first.
                at = XX + f
                if r > 0:
                    at = XXX + f + r - 1
                ws[target + (3 * r + f) * p.stride] = ws[mask + at * p.stride]
        small.cholesky(ws, factor, basis, -1, p.stride)
        small.solve(ws, factor, target, basis, 3, p.stride)
        for k in range(2):
            mean = ws[mask + (1 + k) * p.stride] / ti.max(ws[mask], V(1e-30))
            ws[region(p, number, Region.CENTROID) + k * p.stride] = ti.select(cut, mean, V(0.0))
        for e in range(9):
            whole = precise(0.0)
            if e == 0 or e == 2:
                whole = value[p.v + Value.SECOND_MOMENT + e // 2]
            at = target + e * p.stride
            ws[at] = ti.select(cut, ws[at], V(whole))

    @ti.func
    def cut_windows(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Noise, ratios and projection of cut windows; from here on these alone are active."""
        cut = ws[region(p, number, Region.CUT)] > V(0.5)
        ws[region(p, number, Region.ACTIVE)] = ws[region(p, number, Region.CUT)]
        if small.any_lane(cut) == 1:
            load_planes(
                number[p.n + Number.MASK_PLANE], number[p.n + Number.MASK_PLANES], region(p, number, Region.MASK), p,
                ws, J,
            )  # fmt: skip
            noise(cut, p, number, value, ws)
            shapes(cut, p, number, value, ws)
            curved(cut, p, number, value, ws)

    return SimpleNamespace(cut_windows=cut_windows, equation_noise=equation_noise, of_image_square=of_image_square)
