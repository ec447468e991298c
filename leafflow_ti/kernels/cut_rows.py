"""The equations of the motion fit as a window that is cut measures them.

On a plane the flow has the second-order part ``(q1 x² + q2 xy, q1 xy + q2 y²)``. An affine fit takes its projection on
1, x, y over what is seen for its own parameters: it belongs to the rows of the flow and of its derivatives along x, y.
Likewise derivatives along camera and time axes, and the range constraint, are those at the centroid of what is seen:
their rows are made for the pixel and the part of the patch there, then told by the motion of the patch.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.patch import GROWTH, Patch
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.texture import texture_functions
from leafflow_ti.kernels.workspace import MAX_UNKNOWNS, Number, Region, Value

AFFINE_CODES = 3
"""Codes of rows below this are of the flow and its derivatives along x, y."""


@functools.cache
def cut_row_functions(spec: KernelSpec) -> SimpleNamespace:
    """``before`` and ``behind`` a row of code ``code`` is made."""
    precise, V = spec.precise, spec.element
    small, texture = dense(spec), texture_functions(spec)

    @ti.func
    def place(e: ti.i32, p: ti.template(), number: ti.template()) -> ti.i32:
        """Where the elements that CUT_PATCH keeps belong."""
        at = region(p, number, Region.MOTION) + (e - 5) * p.stride
        if e < 5:
            # X, Y, DEPTH; INVERSE_C, INVERSE_DEPTH
            at = region(p, number, Region.PATCH) + ti.select(e < 3, e, e + Patch.INVERSE_C - 3) * p.stride
        return at

    @ti.func
    def before(code: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Go to the centroid, for rows of derivatives along s and t and of the range constraint."""
        if code >= AFFINE_CODES and texture.any_cut(p, number, ws) == 1:
            patch, motion, kept = (
                region(p, number, Region.PATCH), region(p, number, Region.MOTION), region(p, number, Region.CUT_PATCH)
            )  # fmt: skip
            for e in range(8):
                ws[kept + e * p.stride] = ws[place(e, p, number)]
            f, at = value[p.v + Value.F], region(p, number, Region.CENTROID)
            dx, dy = ws[at] * (1.0 / f), ws[at + p.stride] * (1.0 / f)
            ZX, ZY = ws[patch + Patch.SLOPE_X * p.stride], ws[patch + Patch.SLOPE_Y * p.stride]
            # On a plane, Z (1 - ZX x/f - ZY y/f) is the same everywhere.
            nearer = 1.0 - (ZX * dx + ZY * dy) * ws[patch + Patch.INVERSE_C * p.stride]
            farther = 1.0 / nearer
            depth = ws[patch + Patch.DEPTH * p.stride]
            there = depth * farther
            P2 = there - depth
            P0 = P2 * ws[patch + Patch.X * p.stride] + there * dx
            P1 = P2 * ws[patch + Patch.Y * p.stride] + there * dy
            ws[kept + 8 * p.stride], ws[kept + 9 * p.stride], ws[kept + 10 * p.stride] = P0, P1, P2
            ws[patch + Patch.X * p.stride] = ws[patch + Patch.X * p.stride] + dx
            ws[patch + Patch.Y * p.stride] = ws[patch + Patch.Y * p.stride] + dy
            ws[patch + Patch.DEPTH * p.stride] = there
            ws[patch + Patch.INVERSE_DEPTH * p.stride] = ws[patch + Patch.INVERSE_DEPTH * p.stride] * nearer
            ws[patch + Patch.INVERSE_C * p.stride] = ws[patch + Patch.INVERSE_C * p.stride] * farther
            O0, O1, O2 = ws[motion + 3 * p.stride], ws[motion + 4 * p.stride], ws[motion + 5 * p.stride]
            growth = ws[motion + GROWTH * p.stride]
            ws[motion] = ws[motion] + O1 * P2 - O2 * P1 + growth * P0
            ws[motion + p.stride] = ws[motion + p.stride] + O2 * P0 - O0 * P2 + growth * P1
            ws[motion + 2 * p.stride] = ws[motion + 2 * p.stride] + O0 * P1 - O1 * P0 + growth * P2

    @ti.func
    def come_back(p: ti.template(), number: ti.template(), ws: ti.template()):
        """ROW by the motion of the patch instead of that of its part at the centroid."""
        kept, row = region(p, number, Region.CUT_PATCH), region(p, number, Region.ROW)
        for e in range(8):
            ws[place(e, p, number)] = ws[kept + e * p.stride]
        for j in range(3):
            one, two = (j + 1) % 3, (j + 2) % 3
            P1, P2 = ws[kept + (8 + one) * p.stride], ws[kept + (8 + two) * p.stride]
            at = row + (3 + j) * p.stride
            ws[at] = ws[at] + P1 * ws[row + two * p.stride] - P2 * ws[row + one * p.stride]
            at = row + GROWTH * p.stride
            ws[at] = ws[at] + ws[kept + (8 + j) * p.stride] * ws[row + j * p.stride]

    @ti.func
    def bend(k: ti.i32, code: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Add the second-order part's projection to ROW, which has that of a whole window.

        An own flow is measured elsewhere and moved by its own derivatives, with what these have of that part.
        """
        patch, row, stride = region(p, number, Region.PATCH), region(p, number, Region.ROW), p.stride
        for axis in range(2):
            part = region(p, number, Region.CURVED) + ti.select(axis == k, 2 * k, 1) * stride
            moment = ws[part + 3 * code * stride]
            if code == 0 and number[p.n + Number.OWN_FLOW] == 1:
                for j in range(2):
                    moved = ws[region(p, number, Region.GEOMETRY)] * value[p.v + Value.BASELINE + j]
                    moved = (moved - value[p.v + Value.SHIFT + j]) * value[p.v + Value.CAMERA_STEP + j]
                    moment = moment + moved * ws[part + 3 * (1 + j) * stride]
            if code == 0 and axis == k:
                moment = moment - value[p.v + Value.SECOND_MOMENT + k]
            turned = moment * (precise(1.0) / value[p.v + Value.F])
            bent = ws[patch + (Patch.SLOPE_X + axis) * stride] * ws[patch + Patch.INVERSE_C * stride] * turned
            along_x, along_y = turned * ti.cast(axis == 0, precise), turned * ti.cast(axis == 1, precise)
            ws[row + 2 * stride] = ws[row + 2 * stride] + bent * ws[patch + Patch.INVERSE_DEPTH * stride]
            ws[row + 3 * stride] = ws[row + 3 * stride] - bent * ws[patch + Patch.Y * stride] - along_y
            ws[row + 4 * stride] = ws[row + 4 * stride] + bent * ws[patch + Patch.X * stride] + along_x
            ws[row + GROWTH * stride] = ws[row + GROWTH * stride] - bent

    @ti.func
    def behind(
        k: ti.i32, code: ti.i32, result: ti.template(), p: ti.template(), number: ti.template(), value: ti.template(),
        ws: ti.template(),
    ):  # fmt: skip
        """ROW as the cut windows of the group see it; what it gives for the present motion, ``result`` before."""
        found = result
        if texture.any_cut(p, number, ws) == 1:
            if code >= AFFINE_CODES:
                come_back(p, number, ws)
            else:
                bend(k, code, p, number, value, ws)
            row, motion = region(p, number, Region.ROW), region(p, number, Region.MOTION)
            here = small.dot(ws, row, 1, motion, 1, MAX_UNKNOWNS, p.stride)
            found = ti.select(ws[region(p, number, Region.CUT)] > V(0.5), here, found)
        return found

    return SimpleNamespace(before=before, behind=behind)
