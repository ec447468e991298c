"""How much the exact refinement must compute and move, counted from its plan as ``work`` does for the other stages.

Additions, multiplications, divisions and square roots count; selections, limits and addresses do not. Of symmetric
matrices one triangle counts, and a pixel's workspace is taken to stay in a cache.

Stages: ``splines`` (coefficients of the images of one new frame), ``refine`` (all steps, covariances).
"""

from __future__ import annotations

import numpy as np

from leafflow_ti.kernels.refine_tables import DERIVATIVES, GROWTH, SHIFTS, START, Out
from leafflow_ti.plan import Plan
from leafflow_ti.refine_plan import Effort, Refinement
from leafflow_ti.splines import filter_taps, spline_pieces
from leafflow_ti.stages.refine_tables import noise_correlation
from leafflow_ti.work import Work, cholesky_flops, substitution_flops

POSITION = 15
"""Where a homography puts a point: two numerators of 4 flops, one inverse of 5, two products."""
EXPANSION = 12
"""A value from the one where the image was sampled, to second order."""
GAIN = {0: 0, 1: 1, 3: 5, 6: 13}
"""Photometric terms -> brightness of an image at a sample."""
BLUR = 5
"""Weights times the texture's second derivatives."""
TUKEY = 6
RESIDUAL = 2 * BLUR + TUKEY + 6
"""Residual of a sample against the texture, and its weight from the texture of the pass before."""
WARP = 390
"""Of one image: 165 for rotation, Jacobian and path, 125 for the patch's axes, origin and H, 100 for its inverse, the
homography in pixels, and the weights of the blur."""
MOVE = 30
"""What an unknown that moves the patch does to the eight functions of the window."""
TURN = 66
"""What one that turns or stretches it does beyond that."""


def count_refinement(plan: Plan, effort: Effort | None = None) -> dict[str, Work]:
    """Work of the stages per output pixel of one more frame; {} without a refinement.

    ``effort`` per output pixel, by default the most that the plan allows. Images are filtered, and coefficients read,
    once for all the windows that they are part of.
    """
    refine = plan.refine
    if refine is None:
        return {}
    itemsize = 4 if plan.config.precision == "f32" else 8
    effort = effort or Effort.most(refine)
    pixels = plan.x.step**2
    results = 8 * (Out.N + START)  # beside them the start
    return {
        "splines": Work(2 * 2 * len(filter_taps(refine.degree)), 2 * itemsize) * (len(refine.cameras) * pixels),
        "refine": Work(
            refine_flops(refine, effort), itemsize * _images(refine) * pixels + results * effort.refined
        ),
    }  # fmt: skip


def refine_flops(plan: Refinement, effort: Effort) -> float:
    """Flops of so many refined pixels, passes and samplings."""
    old = effort.passes - effort.samplings
    moved = plan.across**2 * _images(plan) * (2 * POSITION + 2 + EXPANSION)
    return (
        effort.samplings * _sampling_flops(plan) + old * moved + effort.passes * _pass_flops(plan)
        + effort.refined * _frame_flops(plan)
    )  # fmt: skip


def _images(plan: Refinement) -> int:
    return len(plan.cameras) * len(plan.frames)


def _sampling_flops(plan: Refinement) -> float:
    """All images at all samples with two derivatives, and the texture's derivatives from theirs."""
    pieces = spline_pieces(plan.degree)
    n_derivatives, across, _ = pieces.shape
    degrees = sum(int(np.flatnonzero(piece).max()) for piece in pieces.reshape(n_derivatives * across, -1))
    weights = 2 * 2 * degrees  # Horner's rule, along both axes
    sums = 2 * across * (n_derivatives * across + DERIVATIVES)  # along x in each row; then these along y
    # By the window's coordinates: gradient, 3 flops each, and second derivatives, 5 each; weighted sums over images.
    pulled = 2 * (3 + 2) + 3 * (5 + 2)
    window = 5 + 3 + SHIFTS - 2  # mean derivatives; E; functions of the window
    return float(plan.across**2 * (_images(plan) * (POSITION + 2 + weights + sums + pulled) + window))


def _pass_flops(plan: Refinement) -> float:
    """One step beside interpolation: warps, texture, sums of residuals, normal equations, their solution."""
    images, n, terms = _images(plan), plan.unknowns, plan.terms
    functions = SHIFTS + terms
    texture = GAIN[terms] + BLUR + 2 + TUKEY + 12
    sums = GAIN[terms] + RESIDUAL + 5 + 2 * functions
    common = 8 + max(0, terms - 1) + 3 * functions * (functions + 1) / 2  # texture; products of the functions
    turning = sum(6 <= i < 9 or i >= GROWTH for i in plan.estimated)
    image = WARP + n * MOVE + turning * TURN + _step_flops(n, terms)
    photometry = cholesky_flops(terms) + substitution_flops(terms, SHIFTS) + 2 * terms * SHIFTS**2 if terms else 0.0
    return (
        plan.across**2 * (images * (texture + sums) + common) + images * image + photometry
        + _normal_flops(n, images) + cholesky_flops(n) + substitution_flops(n, 1)
    )  # fmt: skip


def _step_flops(n: int, terms: int) -> float:
    """Of one image, beside the normal matrix: its weight, moves about their mean, right side, how far it moves, and
    the step of its photometric terms."""
    moves = SHIFTS * n
    right = SHIFTS * (2 * terms + 1) + 2 * moves
    photometry = 2 * moves + terms * (2 * SHIFTS + 3) + substitution_flops(terms, 1) if terms else 0.0
    return 12 + 3 * moves + right + 6 * (2 * n + 3) + photometry


def _normal_flops(n: int, images: int) -> float:
    """Products of moves, metric and moves, summed over the images and scaled."""
    return images * n * (SHIFTS * (2 * SHIFTS + 1) + (n + 1) * SHIFTS) + n * (n + 1)


def _frame_flops(plan: Refinement) -> float:
    """Before the first step and after the last: mass of the window, contradiction of its halves, covariance."""
    images, n, terms = _images(plan), plan.unknowns, plan.terms
    reach = 2 * (len(noise_correlation(plan.thin, plan.degree)) - 1) + 1
    halves = GAIN[terms] + RESIDUAL + 4 + 2 * 2 * SHIFTS
    spread = SHIFTS * (2 * terms + 1 + 2 * 2 * reach)
    noise = 2 * SHIFTS**2
    doubt = 2 * images * n * 3 * SHIFTS
    covariance = substitution_flops(n, n) + _normal_flops(n, images) + 4 * n**3
    return plan.across**2 * (3 + images * halves + spread + noise) + doubt + covariance
