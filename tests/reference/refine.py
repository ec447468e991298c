"""Naive float64 twin of the exact refinement: one output pixel, projections by rays, derivatives by differences.

    V_k(δ) = I_k(x_k(δ)) = g_k(δ) (T(δ) + ½ σ_p² B_k : ∇∇T(δ)),      B_k = D_k^-1 D_k^-T - 1 at the window's centre

with the images smoothed by the prefilter and the pixel's area, of variance σ_p² together: the same in all images, it is
not the same along the surface. Texture T and light g_k are eliminated; Gauss-Newton for the state with the texture's
gradient in place of each image's. Without robust weights: for clean images.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from leafflow_ti.refine_plan import PIXEL_VARIANCE
from leafflow_ti.splines import PREFILTER_SIGMA
from leafflow_ti.synthetic.bound import eliminate, light_terms
from leafflow_ti.synthetic.moving_patch import directions, pulled_back, warp, window, window_derivative

BLUR = PIXEL_VARIANCE + PREFILTER_SIGMA**2
CORRELATED_PX = 6
DEGREE = 5
"""Of the splines: the twin is that of the kernels with ``spline = 5``."""


@dataclass
class Window:
    """Where and how one pixel is refined; ``views`` [K images], ``principal`` (px, py), ``sigma`` [px] of the window.

    ``motion``, ``modes``, ``flat``: unknowns as in ``directions``; ``terms`` of light per image, 0 or 1, 3, 6.
    ``shifts`` [K, 2]: pixels by which the images lie further to the left and up than their cameras saw them (None: none
    do).
    """

    views: object
    principal: tuple
    size: int = 65
    sigma: float = 19.0
    thin: int = 3
    motion: int = 9
    modes: int = 0
    terms: int = 0
    shifts: np.ndarray | None = None
    flat: bool = False

    def __post_init__(self):
        self.offsets = window(self.size, self.thin)
        self.weights = np.exp(-0.5 * np.sum(self.offsets**2, axis=1) / self.sigma**2)
        self.along = directions(self.motion, self.modes, self.flat)
        self.light = light_terms(self.offsets, self.size, self.terms)
        self.images = range(len(self.views.times))
        if self.shifts is None:
            self.shifts = np.zeros((len(self.images), 2))


@dataclass
class Refined:
    """State [15], light [K, terms], texture [S], residual [K, S]; normal matrix and error bars of the unknowns [n]."""

    state: np.ndarray
    light: np.ndarray
    texture: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray  # [K, S, n], texture and light eliminated
    normal: np.ndarray  # [n, n]
    noise: float  # standard deviation in grey values
    covariance: np.ndarray  # [n, n]
    steps: int


def coefficients(images):
    """Spline coefficients of the prefiltered images [K, H, W]."""
    smooth = (ndimage.gaussian_filter(np.asarray(i, float), PREFILTER_SIGMA, mode="mirror", truncate=8) for i in images)
    return np.stack([ndimage.spline_filter(i, DEGREE, mode="mirror") for i in smooth])


def sample(spline, at):
    """Values [S] of a spline at positions [S, 2] (column, row)."""
    return ndimage.map_coordinates(spline, at.T[::-1], order=DEGREE, prefilter=False, mode="mirror")


def differences(spline, at):
    """Value [S], gradient [S, 2] and Hessian [S, 2, 2] of a spline."""
    h = 0.1
    value = sample(spline, at)
    shifted = {(i, j): sample(spline, at + h * np.array([i, j])) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    gradient = [(shifted[1, 0] - shifted[-1, 0]) / (2 * h), (shifted[0, 1] - shifted[0, -1]) / (2 * h)]
    xx, yy = ((shifted[i, j] - 2 * value + shifted[-i, -j]) / h**2 for i, j in ((1, 0), (0, 1)))
    xy = (shifted[1, 1] - shifted[1, -1] - shifted[-1, 1] + shifted[-1, -1]) / (4 * h**2)
    return value, np.stack(gradient, axis=1), np.stack([np.stack([xx, xy], 1), np.stack([xy, yy], 1)], axis=1)


def evaluate(splines, w, state, light):
    """Texture [S], its gradient [S, 2], residual [K, S] and gain [K, S] at a state [15] and light [K, terms]."""
    gain = 1 + light @ w.light.T
    values, gradients, hessians, blurs = [], [], [], []
    centre = np.zeros((1, 2))
    for k in w.images:
        at = warp(w.views, state, w.offsets, k) + np.array(w.principal) - w.shifts[k]
        value, gradient, hessian = differences(splines[k], at)
        d = window_derivative(w.views, state, w.offsets, k)
        values.append(value)
        gradients.append(np.einsum("si,sij->sj", gradient, d) / gain[k][:, None])
        hessians.append(np.einsum("sij,sia,sjb->sab", hessian, d, d) / gain[k][:, None, None])
        inverse = np.linalg.inv(window_derivative(w.views, state, centre, k)[0])
        blurs.append(inverse @ inverse.T - np.eye(2))
    excess = 0.5 * BLUR * np.einsum("kab,sab->ks", np.array(blurs), np.mean(hessians, axis=0))
    values = np.array(values) - gain * excess
    texture = np.sum(gain * values, axis=0) / np.sum(gain**2, axis=0)
    return texture, np.mean(gradients, axis=0), values - gain * texture, gain


def jacobian(w, state, gradient, gain):
    """Derivatives [K, S, n] of what each image shows, for the unknowns, before the texture and light are eliminated."""
    moved = [pulled_back(w.views, state, w.offsets, k, w.along) for k in w.images]
    return np.stack([g[:, None] * np.einsum("si,sij->sj", gradient, m) for g, m in zip(gain, moved, strict=True)])


def noise_correlation(distance):
    """c(Δ): covariance of prefiltered, interpolated white noise at two places ``distance`` [n] px apart, one axis."""
    fine, reach = 50, 16
    u = np.arange(-reach * fine, reach * fine + 1) / fine
    taps = np.arange(-8, 9)
    smoothing = np.exp(-0.5 * (taps / PREFILTER_SIGMA) ** 2)
    impulse = np.zeros(2 * reach + 1)
    impulse[reach + taps] = smoothing / smoothing.sum()
    h = ndimage.map_coordinates(ndimage.spline_filter1d(impulse, DEGREE), [u + reach], order=DEGREE, prefilter=False)
    product = np.correlate(h, h, "full") / fine
    lags = np.arange(-(u.size - 1), u.size) / fine
    return np.interp(np.abs(distance), lags, product)


def sample_correlation(w):
    """Covariance [S, S] of the noise of the samples of one image, per grey value² of the image's noise."""
    apart = w.offsets[:, None] - w.offsets[None]
    c = noise_correlation(apart[..., 0]) * noise_correlation(apart[..., 1])
    return np.where(np.abs(apart).max(axis=-1) <= CORRELATED_PX, c, 0.0)


def information(w, j, texture, residual):
    """Normal matrix [n, n], standard deviation of the noise, and covariance [n, n] of the unknowns.

    The residual has lost to the texture one image's share, to light and state what they explain of correlated noise.
    """
    normal = np.einsum("ksi,s,ksj->ij", j, w.weights, j)
    correlation = sample_correlation(w)
    weighted = w.weights[:, None] * j
    spread = np.einsum("ksi,st,ktj->ij", weighted, correlation, weighted)
    inverse = np.linalg.inv(normal)
    lost = np.trace(inverse @ spread)
    if w.terms:
        lit = texture[:, None] * w.light
        fitted = lit.T @ (w.weights[:, None] * lit)
        weighted = w.weights[:, None] * lit
        lost += (len(w.images) - 1) * np.trace(np.linalg.solve(fitted, weighted.T @ correlation @ weighted))
    known = (len(w.images) - 1) * correlation[0, 0] * w.weights.sum() - lost
    variance = np.sum(w.weights * residual**2) / known
    return normal, np.sqrt(variance), variance * inverse @ spread @ inverse


def refine(splines, w, start, steps=30):
    """Gauss-Newton from the state ``start`` [15] until a step changes no grey value by 1e-7 in the mean square."""
    state, light = np.array(start, float), np.zeros((len(w.images), w.terms))
    for step in range(1, steps + 1):
        texture, gradient, residual, gain = evaluate(splines, w, state, light)
        raw = jacobian(w, state, gradient, gain)
        j = eliminate(raw, texture, w.light, w.weights, gain)
        left = eliminate(residual[..., None], texture, w.light, w.weights, gain)[..., 0]
        normal = np.einsum("ksi,s,ksj->ij", j, w.weights, j)
        scale = 1 / np.sqrt(np.diag(normal))
        right = np.einsum("ksi,s,ks->i", j, w.weights, left)
        change = -scale * np.linalg.solve(normal * np.outer(scale, scale), scale * right)
        state = state + w.along @ change
        if w.terms:
            lit = texture[:, None] * w.light
            # Without what all images share, which belongs to the texture.
            rest = residual + eliminate(raw, texture, w.light[:, :0], w.weights, gain) @ change
            light = (
                light
                + np.linalg.solve(lit.T @ (w.weights[:, None] * lit), np.einsum("sp,s,ks->pk", lit, w.weights, rest)).T
            )
        size = np.sqrt(change @ normal @ change / (w.weights.sum() * len(w.images)))
        if size < 1e-7:
            return finish(splines, w, state, light, step)
    raise ArithmeticError(f"no convergence in {steps} steps: the last changed grey values by {size:g}")


def finish(splines, w, state, light, steps):
    """The result at the state found, its error bars among it."""
    texture, gradient, residual, gain = evaluate(splines, w, state, light)
    j = eliminate(jacobian(w, state, gradient, gain), texture, w.light, w.weights, gain)
    left = eliminate(residual[..., None], texture, w.light, w.weights, gain)[..., 0]
    normal, noise, covariance = information(w, j, texture, left)
    return Refined(state, light, texture, left, j, normal, noise, covariance, steps)
