"""Windows that a mask or a border cuts: what is known beforehand of whole ones, from the moments of their valid part.

With v = 1 for valid samples, ``W_e = Σ w v Δ^e``: the noise covariance of the columns is a sum of these (2.24), no
longer diagonal; that of the normal equations' noise, a sum over w², follows from the ratio of the moments of w² and w;
and the second-order part of the flow of a moving plane, which the affine fit takes for its parameters, is projected on
1, x, y over what is seen. The lists are those of ``stages.mask_moments``.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import Number, Region, Value

UNLIKE = 0.01
"""Squared correlation of two offsets over a window below which the ratio of their moments says less and less: where it
is 0 the geometric mean of the two offsets' own ratios is taken, as in whole windows."""
XX, XXX = 3, 6
"""Where the moments of second and of third degree in x and y begin among the plain ones, behind 1, x, y."""


@functools.cache
def cut_stages(spec: KernelSpec) -> SimpleNamespace:
    """The stage ``cut_windows``."""
    precise, lanes, V = spec.precise, spec.lanes, spec.element
    small = dense(spec)

    @ti.func
    def load_moments(p: ti.template(), number: ti.template(), ws: ti.template(), J: ti.template()):
        """MASK: the moments of the group's pixels."""
        for k in range(number[p.n + Number.MASK_PLANES]):
            begin = (number[p.n + Number.MASK_PLANE] + k) * p.n_pixels + p.pixel
            element = V(0.0)
            if ti.static(lanes == 1):
                element = ti.cast(J[begin], precise)
            else:
                for i in ti.static(range(lanes)):
                    element[i] = ti.cast(J[begin + i], precise)
            ws[region(p, number, Region.MASK) + k * p.stride] = element

    @ti.func
    def noise(
        cut: ti.template(), p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()
    ):
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
    def ratios(
        cut: ti.template(), p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """CUT_RATIO: the ratio of the moments of w² and w for each pair of classes of columns, relative to that of the
        whole window and to that of the constants, which becomes SPREAD."""
        classes, mask = number[p.n + Number.CLASSES], region(p, number, Region.MASK)
        pairs = p.n + number[p.n + Number.CUT_LISTS] + 3 * number[p.n + Number.CUT_NOISES] + number[p.n + Number.FLOW]
        whole = p.v + number[p.n + Number.CUT_VALUES] + number[p.n + Number.CUT_NOISES]
        target, spread = region(p, number, Region.CUT_RATIO), V(1.0)
        for i in range(classes):
            one = pairs + 2 * tri(i, i)
            for j in range(i + 1):
                two, both = pairs + 2 * tri(j, j), pairs + 2 * tri(i, j)
                plain = ws[mask + number[one] * p.stride] * ws[mask + number[two] * p.stride]
                squared = ws[mask + number[one + 1] * p.stride] * ws[mask + number[two + 1] * p.stride]
                root, root_squared = ti.sqrt(ti.max(plain, V(1e-30))), ti.sqrt(ti.max(squared, V(1e-30)))
                alike = ws[mask + number[both] * p.stride] / root
                alike_squared = ws[mask + number[both + 1] * p.stride] / root_squared
                ratio = root_squared / root * (alike * alike_squared + UNLIKE) / (alike * alike + UNLIKE)
                ratio = ratio / value[whole + tri(i, j)]
                if i == 0:
                    spread = ratio
                ws[target + tri(i, j) * p.stride] = ti.select(cut, ratio / spread, V(1.0))
        ws[region(p, number, Region.SPREAD)] = spread

    @ti.func
    def curved(
        cut: ti.template(), p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """CURVED: x², xy, y² projected on 1, x, y over the window."""
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
        cut = ws[region(p, number, Region.OWN_NOISE)] > V(0.5)
        ws[region(p, number, Region.ACTIVE)] = ws[region(p, number, Region.OWN_NOISE)]
        if small.any_lane(cut) == 1:
            load_moments(p, number, ws, J)
            noise(cut, p, number, value, ws)
            ratios(cut, p, number, value, ws)
            curved(cut, p, number, value, ws)

    return SimpleNamespace(cut_windows=cut_windows)
