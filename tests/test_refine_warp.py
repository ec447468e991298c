"""Warps of the refinement and what each unknown does to them, against rays, planes, and differences of these."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from refine_bench import SCENE, SHIFT, Case, X, Y

from leafflow_ti.runtime import Device
from leafflow_ti.stages.estimate import View
from leafflow_ti.stages.refine_tables import RefineTables
from leafflow_ti.synthetic.moving_patch import Views, pulled_back, warp, window

SCENE_OF_MANY = replace(SCENE, n_rows=2, n_cols=3, n_frames=5)
"""Thirty images: more than a vector of them."""


def warps_of(device: Device, case: Case, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Warps [K, Warp.GAIN] in pixels and moves [K, 8 functions, n] of all images at a state [15] as kernels have it."""
    from leafflow_ti.kernels.engine import lane_kernel, ti
    from leafflow_ti.kernels.refine_tables import SHIFTS, Image, Scalar, Size, Warp
    from leafflow_ti.kernels.refine_warp import Slot, warp_functions

    spec = device.dense
    functions, precise, precises = warp_functions(spec), spec.precise, spec.element

    @lane_kernel(spec.lanes)
    def all_warps(
        size_in: ti.types.ndarray(dtype=ti.i32, ndim=1),
        value_in: ti.types.ndarray(dtype=precise, ndim=1),
        image_in: ti.types.ndarray(dtype=precises, ndim=1),
        vectors: ti.types.ndarray(dtype=precises, ndim=1),
        numbers: ti.types.ndarray(dtype=precise, ndim=1),
    ):
        for _ in range(1):
            slot = Slot(real=0, precise=0)
            functions.aim(slot, size_in, value_in, numbers)
            for group in range(size_in[Size.IMAGE_GROUPS]):
                functions.prepare(slot, group, size_in, value_in, image_in, vectors, numbers)

    scene = case.scene
    view = View(scene.f_px, scene.principal, scene.baseline_mm, SHIFT, 0, 0, 1, 1, 1, 1)
    tables = RefineTables.of(case.plan, view, spec.lanes, 64, device.gpu)
    size, lanes = tables.size, spec.lanes
    numbers = device.zeros(size[Size.SLOT_PRECISE] * lanes, "algebra")
    first = size[Size.SCALAR] * lanes
    numbers[first + Scalar.Q : first + Scalar.Q + 15] = state
    numbers[first + Scalar.X0 : first + Scalar.Y0 + 1] = np.array([X, Y]) - scene.principal
    assert len(tables.image) == Image.N
    all_warps(
        device.array(size, "int"), device.array(tables.value, "algebra"),
        device.vectors(device.array(tables.image, "algebra"), lanes), device.vectors(numbers, lanes), numbers,
    )  # fmt: skip
    images, groups = size[Size.IMAGES], size[Size.IMAGE_GROUPS]
    rows = numbers.reshape(-1, lanes)

    def region(name: int, n: int) -> np.ndarray:
        """[images, n]"""
        return np.array(rows[size[name] : size[name] + n * groups]).reshape(n, groups * lanes)[:, :images].T

    n = int(size[Size.UNKNOWNS])
    return region(Size.HOMOGRAPHY, Warp.GAIN), region(Size.MOVES, SHIFTS * n).reshape(-1, SHIFTS, n)


def moved(moves: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """How far window points [S, 2] move over the texture, [S, 2, n], from the coefficients [8, n] of the functions."""
    x, y = offsets.T[:, :, None]
    bent = x * moves[6] + y * moves[7]
    return np.stack(
        [moves[0] + x * (moves[2] + bent) + y * moves[3], moves[1] + x * moves[4] + y * (moves[5] + bent)], 1
    )


def general_state(strain: tuple[float, float, float]) -> np.ndarray:
    return np.array([400.0, 0.4, -0.3, 0.3, -0.2, 0.5, 0.02, -0.03, 0.04, 0.05, 0.03, -0.06, *strain])


@pytest.mark.parametrize(
    ("modes", "strain"),
    [(0, (0.0, 0.0, 0.0)), (1, (0.02, 0.02, 0.0)), (3, (0.0, 0.0, 0.0)), (3, (0.02, -0.01, 0.015))],
    ids=["rigid", "growing", "may-strain", "straining"],
)
def test_every_unknown_moves_the_warps_as_rays_do(
    device: Callable[[str], Device], modes: int, strain: tuple[float, float, float]
) -> None:
    """Central differences of relative steps of 1e-5 know a derivative to 1e-9 or so; round-off adds 1e-8 of a pixel.

    The kernels leave out how the tangents turn with the slopes: a surface that strains differently along them then
    moves by twice the strain until then, times the turn and the distance from the pixel, at most. And they take the
    turn of the acceleration's path to its first order in the angle Ω t: the second moves it by A t²/2 Ω t t/6.
    """
    case = Case(SCENE_OF_MANY, modes=modes)
    state = general_state(strain)
    views, offsets = Views.of(case.scene, X, Y), window(33, 8)
    own = state.copy()
    if modes == 1:
        own[13:] = 0.0
    homographies, moves = warps_of(device("f64"), case, own)
    anisotropic, farthest = modes == 3 and any(strain), np.hypot(*offsets.T).max()
    for k in range(len(views.times)):
        h = homographies[k]
        depth = offsets @ h[6:8] + 1
        seen = np.stack([offsets @ h[0:2] + h[2], offsets @ h[3:5] + h[5]], axis=1) / depth[:, None]
        wanted = warp(views, state, offsets, k) - np.array([X, Y]) + case.scene.principal - case.shifts[k]
        np.testing.assert_allclose(seen, wanted, atol=1e-8)
        found, wanted = moved(moves[k], offsets), pulled_back(views, state, offsets, k, case.unknowns)
        for i in range(found.shape[2]):
            t = abs(views.times[k])
            left_out = 2 * max(map(abs, strain)) * t * farthest if anisotropic and i in (1, 2) else 0
            if i in (6, 7, 8):
                left_out = np.linalg.norm(state[9:12]) * t**4 * np.linalg.norm(state[6:9]) / 12 * SCENE.f_px / state[0]
            limit = 1e-6 + 2e-6 * np.abs(wanted[..., i]).max() + left_out
            np.testing.assert_allclose(found[..., i], wanted[..., i], atol=limit, err_msg=f"{i} in {k}")


@pytest.mark.parametrize("modes", [0, 3])
def test_a_curved_surface_is_seen_as_rays_see_it(device: Callable[[str], Device], modes: int) -> None:
    """To rounding: by half a pixel beside its tangent plane at the edge of the window."""
    from leafflow_ti.kernels.refine_tables import Warp

    case, state, curvature = Case(SCENE_OF_MANY, modes=modes), general_state((0.0, 0.0, 0.0)), (3e-4, -1e-4, 2e-4)
    views, offsets = Views.of(case.scene, X, Y), window(33, 8)
    x, y = offsets.T
    bent = 0.5 * (curvature[0] * x * x + curvature[2] * y * y) + curvature[1] * x * y
    warps, _ = warps_of(device("f64"), case, state)
    farthest = 0.0
    for k in range(len(views.times)):
        h, (bx, by, bz) = warps[k], warps[k, Warp.BEND : Warp.BEND + 3]
        depth = offsets @ h[6:8] + 1 + bz * bent
        seen = np.stack([offsets @ h[0:2] + h[2] + bx * bent, offsets @ h[3:5] + h[5] + by * bent], 1) / depth[:, None]
        wanted = warp(views, state, offsets, k, curvature)
        np.testing.assert_allclose(seen, wanted - np.array([X, Y]) + case.scene.principal - case.shifts[k], atol=1e-8)
        farthest = max(farthest, np.abs(wanted - warp(views, state, offsets, k)).max())
    assert farthest > 0.3
