"""Small scenes refined at single pixels, by the kernels and by the naive twin: the same images, the same starts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from reference import refine as twin

from leafflow_ti.refine_plan import Refinement
from leafflow_ti.runtime import Device
from leafflow_ti.stages.estimate import View
from leafflow_ti.stages.refine import Refined, RefineStage
from leafflow_ti.synthetic.moving_patch import Views, directions, true_state
from leafflow_ti.synthetic.plane import PlaneScene, render, truth

SCENE = PlaneScene(
    f_px=1500.0,
    baseline_mm=(4.0, -3.0),
    n_cols=3,
    n_frames=3,
    size=(101, 97),
    centre=(0.0, 0.0, 400.0),
    zx=0.4,
    zy=-0.3,
    velocity=(0.3, -0.2, 0.5),
    omega=(0.002, -0.003, 0.004),
    acceleration=(0.01, 0.005, -0.01),
    texture="noise",
    wavelengths_mm=(2.0, 9.0),
    offset=120.0,
    amplitude=27.0,
    noise=1.0,
)
"""A patch whose waves are 7.5 px long at least."""

SHIFT = (-15.0, 11.3)
"""Disparity [px/step] that the images no longer hold: integer preshift and fractional offset together."""

X, Y = 53, 46
"""The pixel that is refined, off the principal point."""


@dataclass(frozen=True)
class Case:
    """A scene and how it is refined; ``motion``, ``modes``, ``terms``, ``steps``, ``degree``, ``flat`` as of
    ``Refinement``. ``seen``: offsets of the frames that are there, None: all of the scene; ``interval``: time from one
    frame of the scene to the next as the refinement is told, so that times need not be whole.
    """

    scene: PlaneScene = SCENE
    size: int = 33
    sigma: float = 10.0
    thin: int = 2
    motion: int = 9
    modes: int = 0
    terms: int = 0
    steps: int = 12
    degree: int = 5
    flat: bool = False
    seen: tuple[int, ...] | None = None
    interval: float = 1.0

    @property
    def frames(self) -> tuple[int, ...]:
        """Offsets of the frames that are there."""
        middle = self.scene.n_frames // 2
        return self.seen or tuple(range(-middle, self.scene.n_frames - middle))

    @property
    def plan(self) -> Refinement:
        return Refinement(
            self.steps, self.size, self.sigma, self.thin, tuple(self.interval * t for t in self.frames),
            self.cameras, self.motion, self.modes, self.terms, degree=self.degree, flat=self.flat,
        )  # fmt: skip

    @property
    def cameras(self) -> tuple[tuple[int, int], ...]:
        """Steps (x, y) from the reference camera in the order of the images."""
        scene = self.scene
        rows, cols = range(scene.n_rows), range(scene.n_cols)
        return tuple((x - scene.n_cols // 2, y - scene.n_rows // 2) for y in rows for x in cols)

    @property
    def shifts(self) -> np.ndarray:
        """Of every image [K, 2], px."""
        return np.tile(np.array(self.cameras) * SHIFT, (len(self.frames), 1))

    @cached_property
    def images(self) -> np.ndarray:
        """Blocks [t, cameras, y, x] in single precision; they lie at ``shifts``."""
        scene = self.scene
        x, y = scene.principal
        out = np.empty((len(self.frames), len(self.cameras), *scene.size[::-1]), np.float32)
        frames = [t + scene.n_frames // 2 for t in self.frames]
        for k, (kx, ky) in enumerate(self.cameras):
            at = replace(scene, principal_px=(x - SHIFT[0] * kx, y - SHIFT[1] * ky))
            chosen = ([ky + scene.n_rows // 2], [kx + scene.n_cols // 2])
            out[:, k] = render(at, frames, chosen)[:, 0, 0]
        return out

    def truth_at(self, x: int, y: int) -> np.ndarray:
        """The state [15] at a pixel."""
        state = true_state(truth(self.scene), x, y)
        state[3:] /= self.interval
        state[9:12] /= self.interval
        if self.flat:
            scale = self.scene.f_px / state[0]
            state[:3], state[3:6], state[9:12] = (1, 0, 0), scale * state[3:6], scale * state[9:12]
        return state

    @property
    def truth(self) -> np.ndarray:
        """The state [15] at the pixel (X, Y)."""
        return self.truth_at(X, Y)

    def beside(self, state: np.ndarray) -> np.ndarray:
        """States [..., 15] as an affine model gives them: a little wrong, without acceleration and growth."""
        off = np.array([0.3, 0.01, 0.01, *[0.01] * 3, *[1e-4] * 3, *[0.0] * 6])
        if self.flat:
            off = 0.1 * directions(3, 0, flat=True).sum(axis=1)
        state = state + off
        state[..., 3 + min(self.motion, 6) :] = 0.0
        return state

    @property
    def start(self) -> np.ndarray:
        """Beside the truth at the pixel (X, Y)."""
        return self.beside(self.truth)

    @property
    def unknowns(self) -> np.ndarray:
        """Directions [15, n] of the state that are estimated."""
        return directions(self.motion, self.modes, self.flat)

    def window(self, x: int = X, y: int = Y) -> twin.Window:
        """What the twin refines at a pixel."""
        times, n = np.array(self.plan.frames), len(self.cameras)
        views, principal = Views.of(self.scene, x, y), self.scene.principal
        views = replace(views, cameras=np.tile(views.cameras[:n], (len(times), 1)), times=np.repeat(times, n))
        if self.flat:
            views, principal = replace(views, f_px=1.0, x0=0.0, y0=0.0), (x, y)
        return twin.Window(
            views, principal, self.size, self.sigma, self.thin, self.motion, self.modes, self.terms, self.shifts,
            self.flat,
        )  # fmt: skip

    def twin(self, images: np.ndarray | None = None, window: twin.Window | None = None, **options: Any) -> twin.Refined:
        """What the twin finds in these images (default: the scene's)."""
        flat = (self.images if images is None else images).reshape(-1, *self.images.shape[2:])
        return twin.refine(twin.coefficients(flat), window or self.window(), self.start, **options)

    def stage(
        self, device: Device, images: np.ndarray | None = None, valid: np.ndarray | None = None,
        mask: np.ndarray | None = None,
    ) -> RefineStage:  # fmt: skip
        """The kernels' stage with these images [t, cameras, y, x] (default: the scene's), and where these are valid."""
        scene = self.scene
        images = self.images if images is None else images
        valid = np.ones(images.shape, bool) if valid is None else valid
        width, height = scene.size
        view = View(scene.f_px, scene.principal, scene.baseline_mm, SHIFT, 0, 0, 1, height, width, width)
        stage = RefineStage(device, self.plan, view, height, width)
        grid = (scene.n_rows, scene.n_cols, height, width)
        for block, ok in zip(images, valid, strict=True):
            stage.push(block.astype(device.real("storage")).reshape(grid), ok.reshape(grid))
        stage.set_mask(mask)
        return stage

    def refine(self, device: Device, start: np.ndarray | None = None, **options: Any) -> Refined:
        """What the kernels find at (X, Y), from ``start`` [15]; ``options`` of ``stage``."""
        return at_pixels(self.stage(device, **options), self.scene, [(X, Y)], self.start if start is None else start)


def at_pixels(
    stage: RefineStage, scene: PlaneScene, pixels: list[tuple[int, int]], start: np.ndarray
) -> Refined:  # fmt: skip
    """What the kernels find at pixels (x, y), from ``start`` [15 or n, 15]."""
    x, y = np.array(pixels).T
    rays = np.column_stack([x - scene.principal[0], y - scene.principal[1]])
    if stage.plan.flat:
        rays = np.zeros(rays.shape)
    return stage(y, x, rays, np.broadcast_to(start, (len(x), 15)))


def estimated(state: np.ndarray, case: Case) -> np.ndarray:
    """The unknowns [..., n] in a state [..., 15] of the kernels, which have isotropic growth in one place."""
    return np.asarray(state[..., list(case.plan.estimated)])


def covariance(found: Refined, case: Case, i: int = 0) -> np.ndarray:
    """Covariance [n, n] of the unknowns."""
    return np.asarray(found.covariance[i][np.ix_(case.plan.estimated, case.plan.estimated)])
