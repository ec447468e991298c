"""The refinement of single output pixels on the exact moving patch: Gauss-Newton on the grey values of all images.

On the CPU a task takes a pixel through all its steps, so that its workspace stays in the cache. On a GPU every stage
is a launch, and a thread one vector of samples, one image, or one pixel, whichever the stage can be divided by.
"""

import functools
from enum import IntEnum, auto

from leafflow_ti.kernels.engine import lane_kernel, lane_type, ti
from leafflow_ti.kernels.refine_noise import noise_functions
from leafflow_ti.kernels.refine_results import result_functions
from leafflow_ti.kernels.refine_samples import sample_functions
from leafflow_ti.kernels.refine_solve import solve_functions
from leafflow_ti.kernels.refine_tables import FUNCTIONS, SHIFTS, Scalar, Size
from leafflow_ti.kernels.refine_warp import Slot, warp_functions
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec


class Stage(IntEnum):
    """What is launched on a GPU, and by what it is divided."""

    BEGIN = 0  # pixel
    WINDOW = auto()  # vector of samples
    AIM = auto()  # pixel
    PREPARE = auto()  # vector of images
    HAND_OVER = auto()  # image
    WARP = auto()  # vector of samples
    TEXTURE = auto()  # vector of samples
    MASSES = auto()  # pixel
    GRAM = auto()  # function
    SUMS = auto()  # image
    SOLVE = auto()  # pixel
    HALVES = auto()  # image
    SPREAD = auto()  # shift
    NOISE = auto()  # shift
    FINISH = auto()  # pixel


@functools.cache
def refine_kernel(spec: KernelSpec, taps: int, stage: Stage | None = None):
    """All stages for every pixel of a batch, or (on a GPU) one of them; ``taps``: of the splines along an axis.

    Pixel i of the batch works in slot i, or, on the CPU, in the slot of its task. ``S`` and ``r``, ``P`` and ``p`` are
    the same memory: vectors and numbers. A pixel that is done is left alone.
    """
    real, precise, lanes = spec.real, spec.precise, spec.lanes
    warps, samples, solver = warp_functions(spec), sample_functions(spec, taps), solve_functions(spec)
    noises, results = noise_functions(spec), result_functions(spec)
    scalars = warps.scalars
    reals, precises = lane_type(real, lanes), spec.element

    @ti.func
    def all_stages(
        slot: ti.template(), pixel: ti.i32, size: ti.template(), value: ti.template(), image: ti.template(),
        origin: ti.template(), sample: ti.template(), coef: ti.template(), mask: ti.template(), centre: ti.template(),
        start: ti.template(), S: ti.template(), r: ti.template(), P: ti.template(), p: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        at = centre[pixel]
        solver.begin(slot, pixel, size, image, start, P, p)
        for i in range(size[Size.SAMPLE_GROUPS]):
            samples.window(slot, i, at, size, sample, mask, S, r)
        while p[scalars(slot, size) + Scalar.DONE] < 0.5:
            warps.aim(slot, size, value, p)
            for i in range(size[Size.IMAGE_GROUPS]):
                warps.prepare(slot, i, size, value, image, P, p)
            for i in range(size[Size.IMAGES]):
                warps.hand_over(slot, i, size, p, r)
            if p[scalars(slot, size) + Scalar.RESAMPLE] > 0.5:
                for i in range(size[Size.SAMPLE_GROUPS]):
                    samples.warp(slot, i, at, size, value, origin, sample, coef, S, r, p)
            for i in range(size[Size.SAMPLE_GROUPS]):
                samples.texture(slot, i, size, value, sample, S, r, p)
            solver.masses(slot, size, r, p)
            for i in range(FUNCTIONS):
                samples.gram(slot, i, size, S, p)
            for i in range(size[Size.IMAGES]):
                samples.sums(slot, i, size, value, sample, S, r, p)
            solver.solve(slot, size, value, P, p)
        for i in range(size[Size.IMAGES]):
            samples.halves(slot, i, size, value, sample, S, r, p)
        for i in range(SHIFTS):
            noises.spread_noise(slot, i, size, value, r, p)
        for i in range(SHIFTS):
            noises.noise(slot, i, size, r, p)
        results.finish(slot, pixel, size, value, P, p, out)

    @ti.func
    def one_stage(
        slot: ti.template(), pixel: ti.i32, i: ti.i32, size: ti.template(), value: ti.template(),
        image: ti.template(), origin: ti.template(), sample: ti.template(), coef: ti.template(), mask: ti.template(),
        centre: ti.template(), start: ti.template(), S: ti.template(), r: ti.template(), P: ti.template(),
        p: ti.template(), out: ti.template(),
    ):  # fmt: skip
        if ti.static(stage == Stage.BEGIN):
            solver.begin(slot, pixel, size, image, start, P, p)
        elif ti.static(stage == Stage.WINDOW):
            samples.window(slot, i, centre[pixel], size, sample, mask, S, r)
        elif ti.static(stage == Stage.HALVES):
            samples.halves(slot, i, size, value, sample, S, r, p)
        elif ti.static(stage == Stage.SPREAD):
            noises.spread_noise(slot, i, size, value, r, p)
        elif ti.static(stage == Stage.NOISE):
            noises.noise(slot, i, size, r, p)
        elif ti.static(stage == Stage.FINISH):
            results.finish(slot, pixel, size, value, P, p, out)
        elif p[scalars(slot, size) + Scalar.DONE] < 0.5:
            if ti.static(stage == Stage.AIM):
                warps.aim(slot, size, value, p)
            elif ti.static(stage == Stage.PREPARE):
                warps.prepare(slot, i, size, value, image, P, p)
            elif ti.static(stage == Stage.HAND_OVER):
                warps.hand_over(slot, i, size, p, r)
            elif ti.static(stage == Stage.WARP):
                if p[scalars(slot, size) + Scalar.RESAMPLE] > 0.5:
                    samples.warp(slot, i, centre[pixel], size, value, origin, sample, coef, S, r, p)
            elif ti.static(stage == Stage.TEXTURE):
                samples.texture(slot, i, size, value, sample, S, r, p)
            elif ti.static(stage == Stage.MASSES):
                solver.masses(slot, size, r, p)
            elif ti.static(stage == Stage.GRAM):
                samples.gram(slot, i, size, S, p)
            elif ti.static(stage == Stage.SUMS):
                samples.sums(slot, i, size, value, sample, S, r, p)
            elif ti.static(stage == Stage.SOLVE):
                solver.solve(slot, size, value, P, p)

    @lane_kernel(lanes, long=True, numbers=True)
    def refine(
        first: ti.i32,
        n_pixels: ti.i32,
        parts: ti.i32,
        n_tasks: ti.i32,
        size_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [Size.LIST + unknowns]
        value_in: ti.types.ndarray(dtype=precise, ndim=1),  # [Value]
        image_in: ti.types.ndarray(dtype=precises, ndim=1),  # [Image.N * image groups]
        origin_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [images]: first element of its coefficients
        sample_in: ti.types.ndarray(dtype=reals, ndim=1),  # [3 * sample groups]: δx, δy, weight
        coef_in: ti.types.ndarray(dtype=real, ndim=1),  # [planes * rows * pitch]
        mask_in: ti.types.ndarray(dtype=real, ndim=1),  # [rows * pitch]
        centre_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [pixels]: element of a plane
        start_in: ti.types.ndarray(dtype=precise, ndim=1),  # [pixels * START]: x0, y0, parameters, curvature
        sample_ws: ti.types.ndarray(dtype=reals, ndim=1),  # [slots * SLOT_REAL]
        sample_number_ws: ti.types.ndarray(dtype=real, ndim=1),
        image_ws: ti.types.ndarray(dtype=precises, ndim=1),  # [slots * SLOT_PRECISE]
        image_number_ws: ti.types.ndarray(dtype=precise, ndim=1),
        result_out: ti.types.ndarray(dtype=precise, ndim=1),  # [pixels * Out.N]
    ):
        if ti.static(spec.gpu):
            for n in range(n_pixels * parts):
                i = n // parts
                slot = Slot(real=i * size_in[Size.SLOT_REAL], precise=i * size_in[Size.SLOT_PRECISE])
                one_stage(
                    slot, first + i, n - i * parts, size_in, value_in, image_in, origin_in, sample_in, coef_in,
                    mask_in, centre_in, start_in, sample_ws, sample_number_ws, image_ws, image_number_ws, result_out,
                )  # fmt: skip
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    slot = Slot(real=task * size_in[Size.SLOT_REAL], precise=task * size_in[Size.SLOT_PRECISE])
                    for i in range(task * n_pixels // n_tasks, (task + 1) * n_pixels // n_tasks):
                        all_stages(
                            slot, first + i, size_in, value_in, image_in, origin_in, sample_in, coef_in, mask_in,
                            centre_in, start_in, sample_ws, sample_number_ws, image_ws, image_number_ws, result_out,
                        )  # fmt: skip

    return refine
