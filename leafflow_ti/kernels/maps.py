"""Named maps with standard errors, and the status of each pixel, from the results in the workspace."""

import functools
from enum import IntEnum
from types import SimpleNamespace

from leafflow_ti.kernels.dense import tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.patch import patch_functions
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import Number, Region, Value, batch_kernel
from leafflow_ti.status import Status


class Output(IntEnum):
    """Planes of the output stack; the standard error of plane p is plane ``STD + p``."""

    DISPARITY = 0
    DEPTH = 1
    SLOPE_X = 2
    SLOPE_Y = 3
    MOTION = 4  # 9: velocity, rotation, acceleration
    FLOW_X = 13
    FLOW_Y = 14
    BRIGHTNESS_T = 15
    BRIGHTNESS_TX = 16
    BRIGHTNESS_TY = 17
    BRIGHTNESS_TT = 18
    BRIGHTNESS_SX = 19
    BRIGHTNESS_SY = 20
    BRIGHTNESS_WORLD_X = 21
    BRIGHTNESS_WORLD_Y = 22
    BRIGHTNESS_WORLD_TT = 23
    STD = 24
    DIFFERENCES = 48  # 2 x packed [3]: covariance of the velocity's difference quotients along x and y
    STATUS = 60
    PLANES = 61


@functools.cache
def maps_kernels(spec: KernelSpec) -> SimpleNamespace:
    """The stages that write the output planes: ``measured``, all but the motion, and ``motion``."""
    real, precise, lanes = spec.real, spec.precise, spec.lanes
    patch = patch_functions(spec)
    ok, no_structure, aperture, incoherent = (
        int(s) for s in (Status.OK, Status.NO_STRUCTURE, Status.APERTURE, Status.INCOHERENT)
    )
    not_converged, border = int(Status.NOT_CONVERGED), int(Status.BORDER)
    nan = float("nan")

    @ti.func
    def put(out: ti.template(), plane: ti.i32, pixel: ti.i32, n_pixels: ti.i32, value: precise, variance: precise):
        out[plane * n_pixels + pixel] = ti.cast(value, real)
        out[(Output.STD + plane) * n_pixels + pixel] = ti.cast(ti.sqrt(ti.max(variance, precise(0.0))), real)

    @ti.func
    def classify(
        base: ti.i32, at: ti.i32, i: ti.i32, stride: ti.i32, n_pixels: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(),
    ) -> ti.i32:  # fmt: skip
        """The first of: border, no structure, incoherent, not converged, aperture, ok."""
        ix, iy = number[Number.FLOW_ROWS], number[Number.FLOW_ROWS + 1]
        xx = ti.cast(J[number[Number.LOWER + tri(ix, ix)] * n_pixels + at], precise)
        xy = ti.cast(J[number[Number.LOWER + tri(iy, ix)] * n_pixels + at], precise)
        yy = ti.cast(J[number[Number.LOWER + tri(iy, iy)] * n_pixels + at], precise)
        mass = ti.cast(J[number[Number.EXTRA] * n_pixels + at], precise)
        level = ti.cast(J[(number[Number.EXTRA] + 3) * n_pixels + at], precise)
        gradient = ti.cast(J[(number[Number.EXTRA] + 1) * n_pixels + at], precise)
        smooth = ti.cast(J[(number[Number.EXTRA] + 2) * n_pixels + at], precise)
        noise = precise(0.0)
        energy = precise(0.0)
        lost = 0
        for j in range(number[Number.SOLUTIONS]):
            variance = ws[base + (number[Region.VARIANCE] + j) * stride + i]
            noise += variance / ti.cast(number[Number.SOLUTIONS], precise)
            energy += variance * value[Value.NOISE + number[Number.FLOW] + j]
            shift = precise(0.0)
            for column in range(2):
                p = number[Region.PARAMETERS] + j * number[Number.FLOW] + number[Number.FLOW_ROWS + column]
                shift += ws[base + p * stride + i] ** 2
            if not shift < value[Value.MAX_SHIFT] ** 2:
                lost = 1
        gain = value[Value.GAIN]
        half = (xx + yy) / 2
        weakest = half - ti.sqrt(ti.max(half * half - (xx * yy - xy * xy), precise(0.0)))
        result = ti.cast(ok, ti.i32)
        if mass < value[Value.MIN_MASS]:
            result = border
        elif not half > value[Value.MIN_STRUCTURE] * level:
            result = no_structure
        elif not half > 2 * noise * gain:
            # The constraint explains nothing: there is nothing but noise, or texture that does not move as one.
            result = ti.select(smooth > value[Value.ROUGHEST] * gradient, incoherent, no_structure)
        elif not (energy < value[Value.MAX_RESIDUAL] * value[Value.MAX_RESIDUAL] * 2 * half):
            result = incoherent
        elif ws[base + number[Region.CONVERGED] * stride + i] < 0.5:
            result = not_converged
        elif weakest < 2 * noise * gain or weakest < precise(1e-4) * half:
            result = aperture
        elif lost == 1:
            result = incoherent
        return result

    @ti.func
    def parameter(base: ti.i32, row: ti.i32, stride: ti.i32, number: ti.template()) -> ti.i32:
        """Where the parameter of a motion row lies."""
        column = number[Number.MOTION_SOLUTION] * number[Number.FLOW] + number[Number.MOTION_ROWS + row]
        return base + (number[Region.PARAMETERS] + column) * stride

    @ti.func
    def world(
        base: ti.i32, at: ti.i32, i: ti.i32, stride: ti.i32, n_pixels: ti.i32,
        number: ti.template(), value: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Brightness changes of the material (4.28): slopes along X and Y, and the trend without what moves past.

        All are linear in the image's slopes and trend; the weights' own errors, of geometry and motion, are left out.
        The motion is the one that the reference model's rows give.
        """
        g = base + number[Region.GEOMETRY] * stride + i
        q = base + number[Region.MOTION] * stride + i
        rows = base + number[Region.COV_T] * stride + i
        ray = patch.pixel_ray(at, number, value)
        s = patch.surface(ray, value[Value.F], ws[g], ws[g + stride], ws[g + 2 * stride])
        # Inverse of [∂X/∂x ∂Y/∂x; ∂X/∂y ∂Y/∂y] (5.8): its determinant is (Z0 / f)² / c.
        weight = ti.Matrix.zero(precise, 3, 3)
        weight[0, 0], weight[0, 1] = 1 - s[1] * ray[0], -s[1] * ray[1]
        weight[1, 0], weight[1, 1] = -s[2] * ray[0], 1 - s[2] * ray[1]
        weight *= value[Value.F] / s[0]
        if number[Number.WORLD_MAPS] == 3:
            n = ti.Vector([ws[q], ws[q + stride], ws[q + 2 * stride]], dt=precise)
            Zt = n[2] - s[1] * n[0] - s[2] * n[1]
            for k in ti.static(range(2)):
                past = Zt / s[3] * ray[k] - n[k]  # the surface point seen at the pixel, relative to the material
                for m in ti.static(range(2)):
                    weight[2, m] -= past * weight[k, m]
            weight[2, 2] = 1
        first = number[Number.MOTION_FLOW] + 1  # behind the row of I
        for k in range(number[Number.WORLD_MAPS]):
            result = precise(0.0)
            variance = precise(0.0)
            for r in range(number[Number.WORLD_MAPS]):
                result -= weight[k, r] * ws[parameter(base, first + r, stride, number) + i]
                for c in range(number[Number.WORLD_MAPS]):
                    spread = ws[rows + tri(first + ti.max(r, c), first + ti.min(r, c)) * stride]
                    variance += weight[k, r] * weight[k, c] * spread
            put(out, Output.BRIGHTNESS_WORLD_X + k, at, n_pixels, result, variance)

    @ti.func
    def measured(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Write the planes of status, geometry, flow and brightness that the model has."""
        flow, terms = number[Number.FLOW], number[Number.TERMS]
        solution = number[Number.MOTION_SOLUTION]
        f = value[Value.F]
        for i in range(lanes):
            at = pixel + i
            out[Output.STATUS * n_pixels + at] = ti.cast(
                classify(base, at, i, stride, n_pixels, number, value, J, ws), real
            )
            if terms > 0:
                g = base + number[Region.GEOMETRY] * stride + i
                cov = base + number[Region.GEOMETRY_COV] * stride + i
                nu = ws[g]
                step = value[Value.BASELINE + number[Number.CAMERA_AXIS]]
                put(out, Output.DISPARITY, at, n_pixels, nu * step, ws[cov] * step * step)
                Z0 = -f / nu
                put(out, Output.DEPTH, at, n_pixels, Z0, ws[cov] * (Z0 / nu) * (Z0 / nu))
                if terms > 1:
                    ray = patch.pixel_ray(at, number, value)
                    b = ti.Vector([ws[g + stride], ws[g + 2 * stride]], dt=precise)
                    s = patch.surface(ray, f, nu, b[0], b[1])
                    c = s[3]
                    for k in ti.static(range(2)):
                        # slope = c b Z0, and c depends on both: gradient by (nu, b_x, b_y).
                        own = Z0 * b[k]
                        gradient = ti.Vector.zero(precise, 3)
                        gradient[0] = (
                            c * (-own / nu) * (1 - c * own * ray[k]) + c * c * own * Z0 * b[1 - k] * ray[1 - k] / nu
                        )
                        gradient[1 + k] = c * Z0 * (1 - c * own * ray[k])
                        gradient[2 - k] = -c * c * own * Z0 * ray[1 - k]
                        variance = precise(0.0)
                        for r in ti.static(range(3)):
                            for m in ti.static(range(3)):
                                variance += gradient[r] * ws[cov + (r * terms + m) * stride] * gradient[m]
                        put(out, Output.SLOPE_X + k, at, n_pixels, s[1 + k], variance)
            rows = base + number[Region.COV_T] * stride + i
            if solution >= 0:
                for k in range(2):
                    row = k * number[Number.OFFSETS]
                    p = base + (number[Region.PARAMETERS] + solution * flow + number[Number.FLOW_ROWS + k]) * stride + i
                    put(out, Output.FLOW_X + k, at, n_pixels, ws[p], ws[rows + tri(row, row) * stride])
            if number[Number.BRIGHTNESS_COLUMN] >= 0:
                for j in range(number[Number.CAMERA_SOLUTIONS]):
                    p = base + (number[Region.PARAMETERS] + j * flow + number[Number.BRIGHTNESS_COLUMN]) * stride + i
                    variance = ws[base + (number[Region.BRIGHTNESS_VARIANCE] + j) * stride + i]
                    put(out, Output.BRIGHTNESS_SX + number[Number.CAMERA_AXIS + j], at, n_pixels, -ws[p], variance)
            for j in range(number[Number.BRIGHTNESS_ROWS]):
                row = number[Number.MOTION_FLOW] + j
                p = parameter(base, row, stride, number)
                plane = Output.BRIGHTNESS_T + number[Number.BRIGHTNESS_PLANES + j]
                put(out, plane, at, n_pixels, -ws[p + i], ws[rows + tri(row, row) * stride])
            if number[Number.WORLD_MAPS] > 0:
                world(base, at, i, stride, n_pixels, number, value, ws, out)

    @ti.func
    def motion(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Write the planes of the motion."""
        n = number[Number.UNKNOWNS]
        for i in range(lanes):
            for j in range(9):
                place = number[Number.PLACE + j]
                if place >= 0:
                    q = base + (number[Region.MOTION] + j) * stride + i
                    cov = base + (number[Region.MOTION_COV] + place * n + place) * stride + i
                    # Where no row was left the equations are singular: no number rather than any.
                    determined = ws[cov] > 0 and ws[cov] < precise(1e30)
                    found = ti.select(determined, ws[q], precise(nan))
                    put(out, Output.MOTION + j, pixel + i, n_pixels, found, ws[cov])
            if n >= 3:
                for axis in range(2):
                    for r in range(3):
                        for c in range(r + 1):
                            cov = base + (number[Region.DIFFERENCE_COV] + (axis * n + r) * n + c) * stride + i
                            plane = Output.DIFFERENCES + 6 * axis + tri(r, c)
                            out[plane * n_pixels + pixel + i] = ti.cast(ws[cov], real)

    return SimpleNamespace(measured=batch_kernel(spec, measured), motion=batch_kernel(spec, motion))
