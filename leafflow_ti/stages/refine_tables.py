"""Tables of the refinement's kernels: window, images, camera, splines, noise, and how a workspace is laid out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.refine_plan import PIXEL_VARIANCE, Refinement
from leafflow_ti.splines import PREFILTER_SIGMA, filter_radius, filter_taps, spline, spline_pieces, support
from leafflow_ti.stages.view import View

Array = NDArray[Any]

CPU_BYTES = 256 << 20
"""Workspaces on the CPU, if one for every thread does not take more."""
SLOTS_PER_THREAD = 8
"""Tasks that the pixels of a launch are cut into where memory allows: some take longer than others."""
GPU_BYTES = 1 << 30
"""Workspaces of the pixels of one launch on a GPU."""
DERIVED = 80
"""Numbers of derived maps, their errors, and what they are made of, per pixel."""


@dataclass(frozen=True)
class RefineTables:
    """Tables of the kernels on the host."""

    size: NDArray[np.int32]
    value: Array
    image: Array
    sample: Array

    @classmethod
    def of(cls, plan: Refinement, view: View, lanes: int, pitch: int, gpu: bool) -> RefineTables:
        """For images at ``pitch`` and views with this camera.

        ``lanes``: samples, or images, of a vector; ``gpu``: the warps of all images are made at once.
        """
        from leafflow_ti.kernels.refine_tables import Image, Size, Value

        size, _, _ = _sizes(plan, lanes, gpu)
        correlation = noise_correlation(plan.thin, plan.degree)
        size[Size.PITCH], size[Size.NEIGHBOURS] = pitch, len(correlation) - 1
        k, n_samples = size[Size.IMAGES], size[Size.SAMPLES]
        images, groups = size[Size.IMAGE_GROUPS], size[Size.SAMPLE_GROUPS]
        offsets = plan.thin * (np.arange(plan.across) - plan.across // 2)

        sample = np.zeros((3, groups * lanes))
        sample[0, :n_samples], sample[1, :n_samples] = np.tile(offsets, plan.across), np.repeat(offsets, plan.across)
        weights = np.exp(-0.5 * (sample[0, :n_samples] ** 2 + sample[1, :n_samples] ** 2) / plan.sigma**2)
        sample[2, :n_samples] = weights / weights.sum()

        image = np.zeros((Image.N, images * lanes))
        steps = np.array(plan.cameras, float)
        image[Image.PRESENT, :k] = 1
        image[Image.TIME, :k] = np.repeat(plan.frames, len(steps))
        for axis in range(2):
            image[Image.CAMERA_X + axis, :k] = np.tile(steps[:, axis] * view.baseline_mm[axis], len(plan.frames))
            moved = np.repeat(np.array(plan.frames) * view.motion_px[axis], len(steps))
            image[Image.SHIFT_X + axis, :k] = np.tile(steps[:, axis] * view.shift_px[axis], len(plan.frames)) + moved

        pieces = spline_pieces(plan.degree).ravel()
        value = np.zeros(Value.SPLINE + pieces.size)
        value[Value.FOCAL], value[Value.HALF] = 1.0 if plan.flat else view.f_px, plan.size / 2
        value[Value.SMOOTHING] = 0.5 * (PIXEL_VARIANCE + PREFILTER_SIGMA**2)
        value[Value.LIMIT] = plan.size // 2 + plan.reach
        both = 2 * correlation.sum() - 1
        value[Value.CORRELATION] = both**2 * np.sum(sample[2] ** 2) / np.sum(sample[2])
        value[Value.CORRELATION_AT :][: correlation.size] = correlation
        value[Value.SPLINE :] = pieces
        return cls(size, value, image, sample)


@dataclass(frozen=True)
class Workspaces:
    """``slots`` pixels are worked on at once; of each the workspaces are ``real`` and ``precise`` vectors long."""

    slots: int
    real: int
    precise: int
    slot_bytes: int

    @property
    def bytes(self) -> int:
        """All of them."""
        return self.slots * self.slot_bytes

    @classmethod
    def of(cls, plan: Refinement, lanes: int, itemsize: tuple[int, int], gpu: bool, threads: int) -> Workspaces:
        """``itemsize``: bytes of a number of images and of algebra; ``threads`` of the CPU, which have one at least."""
        _, real, precise = _sizes(plan, lanes, gpu)
        slot_bytes = lanes * (real * itemsize[0] + precise * itemsize[1])
        if gpu:
            return cls(max(1, GPU_BYTES // slot_bytes), real, precise, slot_bytes)
        slots = max(threads, min(SLOTS_PER_THREAD * threads, CPU_BYTES // slot_bytes))
        return cls(slots, real, precise, slot_bytes)


def bytes_per_pixel() -> int:
    """Of one output pixel on the host: start, position, results as they are written and as they are handed on (two
    copies of all covariances), and the maps that are derived from them."""
    from leafflow_ti.kernels.refine_tables import START, Out

    return 8 * (2 * START + 2 * Out.N + DERIVED)


def _sizes(plan: Refinement, lanes: int, gpu: bool) -> tuple[NDArray[np.int32], int, int]:
    """The table ``size`` but for the images' pitch and the noise, and the vectors of a pixel's two workspaces."""
    from leafflow_ti.kernels.refine_tables import DERIVATIVES, FUNCTIONS, SHIFTS, TERMS, Geometry, Scalar, Size, Warp

    unknowns = plan.estimated
    n, k = len(unknowns), len(plan.frames) * len(plan.cameras)
    images, groups = -(-k // lanes), -(-(plan.across**2) // lanes)
    size = np.zeros(Size.LIST + n, np.int32)
    size[Size.LIST :] = unknowns
    for name, entry in {
        Size.UNKNOWNS: n, Size.MODES: plan.modes, Size.TERMS: plan.terms, Size.IMAGES: k,
        Size.IMAGE_GROUPS: images, Size.SAMPLES: plan.across**2, Size.SAMPLE_GROUPS: groups,
        Size.ACROSS: plan.across, Size.STEPS: plan.steps,
    }.items():  # fmt: skip
        size[name] = entry
    warps = -(-k * Warp.N // lanes)
    slot_real = _lay_out(size, {
        Size.SEEN: DERIVATIVES * k * groups, Size.VALUES: k * groups, Size.TEXTURE: groups, Size.BEFORE: groups,
        Size.FUNCTION: FUNCTIONS * groups, Size.BLUR: 3 * groups, Size.WEIGHT: groups,
        Size.SCRATCH: 2 * SHIFTS * groups, Size.WARP: warps,
        Size.SPLINES: 6 * (plan.degree + 1) * (groups if gpu else 1),
    })  # fmt: skip
    slot_precise = _lay_out(size, {
        Size.MOVES: SHIFTS * n * images, Size.SUMS: FUNCTIONS * images, Size.ENERGY: images, Size.MASS: images,
        Size.TRUST: images, Size.KEPT: images, Size.GAIN: TERMS * images, Size.GAIN_STEP: TERMS * images,
        Size.HOMOGRAPHY: Warp.GAIN * images, Size.PRODUCT: SHIFTS, Size.NORMAL: n * (n + 1) // 2, Size.RIGHT: n,
        Size.HALVES: 2 * SHIFTS * images,
        Size.SCALAR: -(-Scalar.N // lanes), Size.GEOMETRY: Geometry.N * (images if gpu else 1),
    })  # fmt: skip
    size[Size.SLOT_REAL], size[Size.SLOT_PRECISE] = slot_real, slot_precise
    return size, slot_real, slot_precise


def _lay_out(size: NDArray[np.int32], lengths: dict[Any, int]) -> int:
    """Put regions behind one another, their first elements into ``size``; the length of all."""
    at = 0
    for name, length in lengths.items():
        size[name] = at
        at += length
    return at


def noise_correlation(thin: int, degree: int) -> Array:
    """Correlation of the noise of warped images at 0, ``thin``, 2 ``thin``, ... px, until it is below 1e-3.

    White noise that is filtered and interpolated at positions that fall anywhere between the pixels has, on average,
    the autocorrelation of the cardinal spline of the filter.
    """
    fine = 32
    taps, radius = filter_taps(degree), filter_radius(degree) + support(degree)
    u = np.arange(-radius * fine, radius * fine + 1) / fine
    impulse = np.sum([tap * spline(u - r, degree) for r, tap in enumerate(taps, -filter_radius(degree))], axis=0)
    found = np.correlate(impulse, impulse, "full")
    found = found[len(u) - 1 :: thin * fine] / found[len(u) - 1]
    return np.asarray(found[: int(np.flatnonzero(np.abs(found) > 1e-3).max()) + 1])
