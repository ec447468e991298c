"""The Cramér-Rao bound of a moving patch: how exactly its state can be known at best from noisy images of it.

The grey values of all images of a window depend on the patch's state, on its unknown texture and on unknown light. With
white noise the inverse of the state's information, both nuisances eliminated, bounds the covariance of every unbiased
estimate. Every pixel of the window counts in every image; images are taken to sample the patch as densely as the
reference image does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.geometry import Array
from leafflow_ti.synthetic.moving_patch import Views, directions, pulled_back, true_state, window
from leafflow_ti.synthetic.scene import SingleScene, render_image, truth

GRADIENT_STEP = 1e-3
"""Half the distance [px] of the two images whose difference is the texture's gradient."""

SINGULAR = 1e-12
"""Least eigenvalue of the information, in units of its largest once its diagonal is 1, that counts as information."""


def cramer_rao(
    scene: SingleScene, x: int, y: int, size: int, *, motion: int = 9, modes: int = 0, terms: int = 0,
    sigma: float | None = None,
) -> Array:  # fmt: skip
    """Least covariance [n, n] of the state at pixel (x, y) from windows of ``size`` px, for noise of 1 grey value.

    Unknowns as ``directions(motion, modes)``; ``terms`` of light per image, see ``light_terms``. ``sigma`` [px]: pixels
    count like those of a Gaussian window, 1 at its centre (None: all alike). Strain rates are parts per frame. Raises
    UsageError where the window leaves some unknown undetermined.
    """
    offsets = window(size)
    views = Views.of(scene, x, y)
    state, along = true_state(truth(scene), x, y), directions(motion, modes)
    texture, gradient = _texture(scene, x, y, size)
    weights = np.ones(len(offsets)) if sigma is None else np.exp(-0.5 * np.sum(offsets**2, axis=1) / sigma**2)
    jacobian = np.stack(
        [
            np.einsum("si,sij->sj", gradient, pulled_back(views, state, offsets, k, along))
            for k in range(len(views.times))
        ]
    )
    jacobian = eliminate(jacobian, texture, light_terms(offsets, size, terms), weights, np.ones(jacobian.shape[:2]))
    information = np.einsum("ksi,s,ksj->ij", jacobian, weights, jacobian)
    scale = np.sqrt(np.diag(information))
    if not (scale > 0.0).all() or np.linalg.eigvalsh(information / np.outer(scale, scale))[0] < SINGULAR:
        raise UsageError(f"pixel ({x}, {y}): the images do not determine all unknowns of the patch: leave some out")
    return np.asarray(np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale))


def light_terms(offsets: Array, size: int, terms: int) -> Array:
    """The first ``terms`` (0, 1, 3, 6) of 1, u, v, u², uv, v² [S, terms] at offsets [S, 2] in units of size/2."""
    u, v = 2.0 / size * offsets.T
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)[:, :terms]


def eliminate(values: Array, texture: Array, light: Array, weights: Array, gain: Array) -> Array:
    """``values`` [K, S, n] of K images less what texture or light could explain.

    A change of ``texture`` [S] is seen alike, times ``gain`` [K, S], by all images; a change of light in image k is the
    texture times ``light`` [S, terms]. ``weights`` [S] of the squares. Exact for equal gains.
    """
    common = np.einsum("ks,ksn->sn", gain, values) / np.sum(gain**2, axis=0)[:, None]
    values = values - gain[:, :, None] * common
    if light.shape[1] == 0:
        return values
    lit = texture[:, None] * light
    normal = lit.T @ (weights[:, None] * lit)
    shares = np.linalg.solve(normal, np.einsum("sp,s,ksn->kpn", lit, weights, values))
    return np.asarray(values - np.einsum("sp,kpn->ksn", lit, shares))


def _texture(scene: SingleScene, x: int, y: int, size: int) -> tuple[Array, Array]:
    """Grey values [S] of the reference image's window, free of noise, and their gradient [S, 2] per px."""
    reach = size // 2
    px, py = scene.principal
    row, col, frame = scene.n_rows // 2, scene.n_cols // 2, scene.reference_frame
    clean = replace(scene, size=(2 * reach + 1, 2 * reach + 1), noise=0.0, bits=None)

    def grey(dx: float, dy: float) -> Array:
        crop = replace(clean, principal_px=(px - x + reach - dx, py - y + reach - dy))
        return render_image(crop, frame, row, col).reshape(-1)

    h = GRADIENT_STEP
    gradient = [(grey(h, 0.0) - grey(-h, 0.0)) / (2.0 * h), (grey(0.0, h) - grey(0.0, -h)) / (2.0 * h)]
    return grey(0.0, 0.0), np.stack(gradient, axis=1)
