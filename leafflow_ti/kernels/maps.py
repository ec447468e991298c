"""Named maps with standard errors, and the status of each pixel, from the results in the workspace."""

import functools
from enum import IntEnum
from types import SimpleNamespace

from leafflow_ti.kernels.dense import tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.patch import patch_functions
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.texture import texture_functions
from leafflow_ti.kernels.workspace import Number, Region, Value
from leafflow_ti.status import Status


class Output(IntEnum):
    """Planes of the output stack; the standard error of plane p is plane ``STD + p``.

    No model has both a motion in space and derivatives of one camera's flow: they share planes.
    """

    DISPARITY = 0
    DEPTH = 1
    SLOPE_X = 2
    SLOPE_Y = 3
    MOTION = 4  # 9: velocity, rotation, acceleration
    FLOW_XX = 4
    FLOW_XY = 5
    FLOW_YX = 6
    FLOW_YY = 7
    STRAIN_XX = 8
    STRAIN_YY = 9
    STRAIN_XY = 10
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
    NORMAL_FLOW_X = 24
    NORMAL_FLOW_Y = 25
    STD = 26
    DIFFERENCES = 52  # 2 x packed [3]: covariance of the velocity's difference quotients along x and y
    STATUS = 64
    CONFIDENCE = 65
    SUPPORT = 66
    VELOCITY_CORRELATION_XY = 67
    VELOCITY_CORRELATION_XZ = 68
    VELOCITY_CORRELATION_YZ = 69
    PLANES = 70


EXPECTED = 10.0
"""How many times the expected residual leaves no confidence."""
LEAST_SUPPORT = 0.01
"""Share of the window below which a robust estimate rests on too little."""
TINY = 1e-30


@functools.cache
def maps_stages(spec: KernelSpec) -> SimpleNamespace:
    """The stages ``measured`` (all maps but the motion), ``motion``, and ``emit``, which writes them to the planes."""
    real, precise, lanes, V = spec.real, spec.precise, spec.lanes, spec.element
    patch, texture = patch_functions(spec), texture_functions(spec)
    ok, no_structure, aperture, incoherent = (
        float(s) for s in (Status.OK, Status.NO_STRUCTURE, Status.APERTURE, Status.INCOHERENT)
    )
    not_converged, border = float(Status.NOT_CONVERGED), float(Status.BORDER)
    nan = float("nan")

    @ti.func
    def put(
        plane: ti.i32, result: ti.template(), variance: ti.template(), p: ti.template(), target: ti.i32,
        ws: ti.template(),
    ):  # fmt: skip
        """One map and its standard error; no number where the variance is none, or negative by rounding."""
        ws[target + plane * p.stride] = result
        std = ti.select(variance >= V(0.0), ti.sqrt(ti.max(variance, V(0.0))), V(nan))
        ws[target + (Output.STD + plane) * p.stride] = std

    @ti.func
    def classify(p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """The status, the first of: border, no structure, incoherent, not converged, aperture, ok; and the confidence.

        With the noise level known, that much of the residual is no sign of incoherence, up to half of it: the level may
        be that of a fine texture. The confidence is that of (2.18), ((τ - λ) / (τ + λ))² for residual variances λ < τ,
        τ being ``EXPECTED`` times what noise and the model's own misfit amount to, times ``(s / (s + e))²`` with s the
        least energy of the gradient in any direction beyond its noise, and e the energy of the residual; and times the
        support of a window that was weighted anew, whose residual is small by what was left out.
        """
        found, target = region(p, number, Region.PARAMETERS), region(p, number, Region.OUT)
        xx, xy, yy = texture.gradient(p, number, ws)
        extra = region(p, number, Region.MOMENTS) + number[p.n + Number.EXTRA] * p.stride
        mass, gradient = ws[extra], ws[extra + p.stride]
        smooth, level = ws[extra + 2 * p.stride], ws[extra + 3 * p.stride]
        solutions = number[p.n + Number.SOLUTIONS]
        known = value[p.v + Value.NOISE_LEVEL]
        noise, energy, excess, farthest, gains = V(0.0), V(0.0), V(0.0), V(0.0), precise(0.0)
        for j in range(solutions):
            variance = ws[region(p, number, Region.VARIANCE) + j * p.stride]
            noise = noise + variance * (1.0 / ti.cast(solutions, precise))
            gain = value[p.v + Value.NOISE + number[p.n + Number.FLOW] + j]
            gains += gain
            energy = energy + variance * gain
            excess = excess + (variance - ti.min(V(known), variance * precise(0.5))) * gain
            shift = V(0.0)
            for k in range(2):
                column = j * number[p.n + Number.FLOW] + number[p.n + Number.FLOW_ROWS + k]
                u = ws[found + column * p.stride]
                shift = shift + u * u
            limit = value[p.v + Value.MAX_SHIFT]
            farthest = ti.select(shift < V(limit * limit), farthest, V(1.0))  # also where it is no number
        floor = texture.noise_variance(noise, p, value) * (2.0 * value[p.v + Value.GAIN])
        half = (xx + yy) * 0.5
        weakest = half - ti.sqrt(ti.max(half * half - (xx * yy - xy * xy), V(0.0)))
        least = 2.0 * value[p.v + Value.LEAST_SHARE]
        # From the last reason to the first, which is the one that counts.
        result = ti.select(farthest > V(0.5), V(incoherent), V(ok))
        result = ti.select((weakest < floor) | (weakest < half * least), V(aperture), result)
        unsolved = ws[region(p, number, Region.CONVERGED)] < V(0.5)
        result = ti.select(unsolved, V(not_converged), result)
        largest = value[p.v + Value.MAX_RESIDUAL]
        result = ti.select(excess < half * (2.0 * largest * largest), result, V(incoherent))
        if number[p.n + Number.REWEIGHTED] == 1:
            share = ws[region(p, number, Region.SHARE)]
            ws[target + Output.SUPPORT * p.stride] = ti.min(share, V(1.0))
            # A fit to next to nothing of the window explains anything.
            result = ti.select(share < V(LEAST_SUPPORT), V(incoherent), result)
        # The constraint explains nothing: there is nothing but noise, or texture that does not move as one.
        rough = smooth > gradient * value[p.v + Value.ROUGHEST]
        nothing = ti.select(rough, V(incoherent), V(no_structure))
        result = ti.select(half > floor, result, nothing)
        result = ti.select(half > level * value[p.v + Value.MIN_STRUCTURE], result, V(no_structure))
        expected = (V(known * gains) + half * value[p.v + Value.MISFIT]) * EXPECTED
        agreement = ti.max(expected - energy, V(0.0)) / ti.max(expected + energy, V(TINY))
        beyond = ti.max(weakest - floor * precise(0.5), V(0.0))
        structure = beyond / ti.max(beyond + energy, V(TINY))
        confidence = agreement * agreement * structure * structure
        if number[p.n + Number.REWEIGHTED] == 1:
            confidence = confidence * ws[target + Output.SUPPORT * p.stride]
        ws[target + Output.CONFIDENCE * p.stride] = confidence
        ws[target + Output.STATUS * p.stride] = ti.select(mass < V(value[p.v + Value.MIN_MASS]), V(border), result)

    @ti.func
    def geometry_maps(p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Disparity, depth and slopes."""
        target, f, terms = region(p, number, Region.OUT), value[p.v + Value.F], number[p.n + Number.TERMS]
        g, cov = region(p, number, Region.GEOMETRY), region(p, number, Region.GEOMETRY_COV)
        nu, spread = ws[g], ws[cov]
        step = value[p.v + Value.BASELINE + number[p.n + Number.CAMERA_AXIS]]
        put(Output.DISPARITY, nu * step, spread * (step * step), p, target, ws)
        Z0 = (0.0 - f) / nu
        ratio = Z0 / nu
        put(Output.DEPTH, Z0, spread * ratio * ratio, p, target, ws)
        if terms > 1:
            x, y = patch.pixel_ray(p, number, value)
            c = 1.0 / (1.0 + Z0 * (ws[g + p.stride] * x + ws[g + 2 * p.stride] * y))
            for k in range(2):
                # slope = c b Z0, and c depends on both: gradient by (nu, b_k, the other b).
                ray, other = x, y
                if k == 1:
                    ray, other = y, x
                own = Z0 * ws[g + (1 + k) * p.stride]
                beside = Z0 * ws[g + (2 - k) * p.stride]
                by_nu = c * own / nu * (c * (own * ray + beside * other) - 1.0)
                by_own = c * Z0 * (1.0 - c * own * ray)
                by_other = 0.0 - c * c * own * Z0 * other
                first, second = cov + (1 + k) * p.stride, cov + (2 - k) * p.stride
                variance = by_nu * by_nu * spread
                variance = variance + 2.0 * by_nu * (by_own * ws[first] + by_other * ws[second])
                variance = variance + by_own * by_own * ws[first + (1 + k) * terms * p.stride]
                variance = variance + by_other * by_other * ws[second + (2 - k) * terms * p.stride]
                variance = variance + 2.0 * by_own * by_other * ws[first + (2 - k) * terms * p.stride]
                put(Output.SLOPE_X + k, c * own, variance, p, target, ws)

    @ti.func
    def normal_flow(p: ti.template(), number: ti.template(), ws: ti.template()):
        """The flow's component along the window's dominant gradient (2.23).

        Its size is as uncertain as the covariance says, its direction as much for every pixel of its size.
        """
        target, rows = region(p, number, Region.OUT), region(p, number, Region.COV_T)
        offsets = number[p.n + Number.OFFSETS]
        xx, xy, yy = texture.gradient(p, number, ws)
        difference = (xx - yy) * 0.5
        share = difference / ti.max(ti.sqrt(difference * difference + xy * xy), V(TINY))
        nx = ti.sqrt(ti.max((share + 1.0) * 0.5, V(0.0)))
        ny = ti.sqrt(ti.max((1.0 - share) * 0.5, V(0.0)))
        ny = ti.select(xy < V(0.0), 0.0 - ny, ny)
        size = nx * ws[target + Output.FLOW_X * p.stride] + ny * ws[target + Output.FLOW_Y * p.stride]
        variance = nx * nx * ws[rows] + ny * ny * ws[rows + tri(offsets, offsets) * p.stride]
        variance = variance + 2.0 * nx * ny * ws[rows + tri(offsets, 0) * p.stride]
        turned = size * size
        put(Output.NORMAL_FLOW_X, size * nx, variance * (nx * nx + ny * ny * turned), p, target, ws)
        put(Output.NORMAL_FLOW_Y, size * ny, variance * (ny * ny + nx * nx * turned), p, target, ws)

    @ti.func
    def parameter(row: ti.i32, p: ti.template(), number: ti.template()) -> ti.i32:
        """Where the parameter of a motion row lies."""
        column = number[p.n + Number.MOTION_SOLUTION] * number[p.n + Number.FLOW]
        column += number[p.n + Number.MOTION_ROWS + row]
        return region(p, number, Region.PARAMETERS) + column * p.stride

    @ti.func
    def flow_gradient(p: ti.template(), number: ti.template(), ws: ti.template()):
        """The flow's derivatives along x and y, and their symmetric part: strain of the image plane, in per cent.

        Rows are those of u, then of v: each with its derivatives along x and y.
        """
        target, rows = region(p, number, Region.OUT), region(p, number, Region.COV_T)
        for k in range(2):
            for axis in range(2):
                row = 3 * k + 1 + axis
                value, variance = ws[parameter(row, p, number)], ws[rows + tri(row, row) * p.stride]
                put(Output.FLOW_XX + 2 * k + axis, value, variance, p, target, ws)
                if k == axis:
                    put(Output.STRAIN_XX + k, 100.0 * value, 1e4 * variance, p, target, ws)
        shear = ws[parameter(2, p, number)] + ws[parameter(4, p, number)]
        variance = ws[rows + tri(2, 2) * p.stride] + ws[rows + tri(4, 4) * p.stride]
        variance = variance + 2.0 * ws[rows + tri(4, 2) * p.stride]
        put(Output.STRAIN_XY, 50.0 * shear, 2500.0 * variance, p, target, ws)

    @ti.func
    def world(p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Brightness changes of the material (4.28): slopes along X and Y, and the trend without what moves past.

        All are linear in the image's slopes and trend; the weights' own errors, of geometry and motion, are left out.
        The motion is the one that the reference model's rows give.
        """
        n, weight = number[p.n + Number.WORLD_MAPS], region(p, number, Region.MOTION_WORK)
        g, q = region(p, number, Region.GEOMETRY), region(p, number, Region.MOTION)
        rows, f = region(p, number, Region.COV_T), value[p.v + Value.F]
        x, y = patch.pixel_ray(p, number, value)
        Z0 = (0.0 - f) / ws[g]
        P = ws[g + p.stride] * Z0
        Q = ws[g + 2 * p.stride] * Z0
        c = 1.0 / (1.0 + P * x + Q * y)
        ZX = c * P
        ZY = c * Q
        # Inverse of [∂X/∂x ∂Y/∂x; ∂X/∂y ∂Y/∂y] (5.8): its determinant is (Z0 / f)² / c.
        scale = f / Z0
        ws[weight] = scale * (1.0 - ZX * x)
        ws[weight + p.stride] = 0.0 - scale * ZX * y
        ws[weight + 3 * p.stride] = 0.0 - scale * ZY * x
        ws[weight + 4 * p.stride] = scale * (1.0 - ZY * y)
        ws[weight + 2 * p.stride] = V(0.0)
        ws[weight + 5 * p.stride] = V(0.0)
        if n == 3:
            N0, N1 = ws[q], ws[q + p.stride]
            Zt = ws[q + 2 * p.stride] - ZX * N0 - ZY * N1
            # The surface point seen at the pixel, relative to the material.
            past_x = Zt / c * x - N0
            past_y = Zt / c * y - N1
            for m in range(2):
                moved = past_x * ws[weight + m * p.stride] + past_y * ws[weight + (3 + m) * p.stride]
                ws[weight + (6 + m) * p.stride] = 0.0 - moved
            ws[weight + 8 * p.stride] = V(1.0)
        first = number[p.n + Number.MOTION_FLOW] + 1  # behind the row of I
        for k in range(n):
            result, variance = V(0.0), V(0.0)
            for r in range(n):
                one = ws[weight + (3 * k + r) * p.stride]
                result = result - one * ws[parameter(first + r, p, number)]
                for m in range(n):
                    spread = ws[rows + tri(first + ti.max(r, m), first + ti.min(r, m)) * p.stride]
                    variance = variance + one * ws[weight + (3 * k + m) * p.stride] * spread
            put(Output.BRIGHTNESS_WORLD_X + k, result, variance, p, region(p, number, Region.OUT), ws)

    @ti.func
    def measured(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """The maps of status, geometry, flow and brightness that the model has."""
        target, found = region(p, number, Region.OUT), region(p, number, Region.PARAMETERS)
        flow, rows = number[p.n + Number.FLOW], region(p, number, Region.COV_T)
        classify(p, number, value, ws)
        if number[p.n + Number.TERMS] > 0:
            geometry_maps(p, number, value, ws)
        if number[p.n + Number.MOTION_SOLUTION] >= 0:
            for k in range(2):
                row = k * number[p.n + Number.OFFSETS]
                column = number[p.n + Number.MOTION_SOLUTION] * flow + number[p.n + Number.FLOW_ROWS + k]
                variance = ws[rows + tri(row, row) * p.stride]
                flowing = ws[found + column * p.stride] + value[p.v + Value.MOTION_SHIFT + k]
                put(Output.FLOW_X + k, flowing, variance, p, target, ws)
            normal_flow(p, number, ws)
            if number[p.n + Number.UNKNOWNS] == 0 and number[p.n + Number.OFFSETS] > 1:
                flow_gradient(p, number, ws)
        if number[p.n + Number.BRIGHTNESS_COLUMN] >= 0:
            for j in range(number[p.n + Number.CAMERA_SOLUTIONS]):
                at = found + (j * flow + number[p.n + Number.BRIGHTNESS_COLUMN]) * p.stride
                variance = ws[region(p, number, Region.BRIGHTNESS_VARIANCE) + j * p.stride]
                plane = Output.BRIGHTNESS_SX + number[p.n + Number.CAMERA_AXIS + j]
                put(plane, 0.0 - ws[at], variance, p, target, ws)
        for j in range(number[p.n + Number.BRIGHTNESS_ROWS]):
            row = number[p.n + Number.MOTION_FLOW] + j
            plane = Output.BRIGHTNESS_T + number[p.n + Number.BRIGHTNESS_PLANES + j]
            put(plane, 0.0 - ws[parameter(row, p, number)], ws[rows + tri(row, row) * p.stride], p, target, ws)
        if number[p.n + Number.WORLD_MAPS] > 0:
            world(p, number, value, ws)

    @ti.func
    def correlation(r: ti.i32, c: ti.i32, p: ti.template(), number: ti.template(), ws: ti.template()):
        """Correlation of the errors of two components r > c of the velocity, where both are unknowns."""
        n, cov = number[p.n + Number.UNKNOWNS], region(p, number, Region.MOTION_COV)
        one, two = number[p.n + Number.PLACE + r], number[p.n + Number.PLACE + c]
        if one >= 0 and two >= 0:
            both = ws[cov + one * (n + 1) * p.stride] * ws[cov + two * (n + 1) * p.stride]
            found = ws[cov + (one * n + two) * p.stride] / ti.sqrt(both)
            plane = Output.VELOCITY_CORRELATION_XY + r * (r - 1) // 2 + c
            ws[region(p, number, Region.OUT) + plane * p.stride] = ti.max(ti.min(found, V(1.0)), V(0.0 - 1.0))

    @ti.func
    def motion(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """The maps of the motion."""
        n, target = number[p.n + Number.UNKNOWNS], region(p, number, Region.OUT)
        cov = region(p, number, Region.MOTION_COV)
        for j in range(9):
            place = number[p.n + Number.PLACE + j]
            if place >= 0:
                variance = ws[cov + place * (n + 1) * p.stride]
                # Where no row was left the equations are singular: no number rather than any.
                determined = (variance > V(0.0)) & (variance < V(1e30))
                found = ti.select(determined, ws[region(p, number, Region.MOTION) + j * p.stride], V(nan))
                put(Output.MOTION + j, found, variance, p, target, ws)
        for r in range(1, 3):
            for c in range(r):
                correlation(r, c, p, number, ws)
        if n >= 3:
            for axis in range(2):
                for r in range(3):
                    for c in range(r + 1):
                        at = region(p, number, Region.DIFFERENCE_COV) + ((axis * n + r) * n + c) * p.stride
                        ws[target + (Output.DIFFERENCES + 6 * axis + tri(r, c)) * p.stride] = ws[at]

    @ti.func
    def emit(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Write all maps of the group to their planes; those that the model does not have hold anything."""
        target = region(p, number, Region.OUT)
        for plane in range(Output.PLANES):
            element = ws[target + plane * p.stride]
            at = plane * p.n_pixels + p.pixel
            if ti.static(lanes == 1):
                out[at] = ti.cast(element, real)
            else:
                for i in ti.static(range(lanes)):
                    out[at + i] = ti.cast(element[i], real)

    return SimpleNamespace(measured=measured, motion=motion, emit=emit)
