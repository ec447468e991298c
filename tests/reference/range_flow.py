"""Naive float64 twin of range flow: both constraints written out sample by sample (Schuchert 2010, (3.9), (4.20)).

Only filters, window weights and noise factors come from the library.
"""

import numpy as np
from reference import chain
from scipy.ndimage import correlate

from leafflow_ti.sampling import Sampling

SECOND = {
    "none": [],
    "time": ["tt", "xt", "yt"],
    "space": ["xx", "xy", "yy"],
    "both": ["tt", "xt", "yt", "xx", "xy", "yy"],
}


def derivatives(images, sampling: Sampling):
    """Derivatives along x, y, t of [t, y, x], and the smoothed images."""
    return {c: chain.derivative(images[:, None, None], sampling, c)[:, 0, 0] for c in ("x", "y", "t", "i")}


def gradients(images, sampling: Sampling):
    """Derivative images along x and y of every frame, and the norms of their filters."""
    found = []
    for axis in ("x", "y"):
        kernel = np.outer(sampling.y.kernel(axis == "y"), sampling.x.kernel(axis == "x"))
        found.append((correlate(images, kernel[None], mode="nearest"), np.sqrt(np.sum(kernel**2))))
    return found


def radius(sampling: Sampling):
    """Root of the second moment of the window along an axis."""
    weights = np.array(sampling.x.weights)
    return np.sqrt(np.sum(weights * (np.arange(weights.size) - weights.size // 2) ** 2.0))


def window_of(images, depth, noise, image_noise, beta, constraint, terms, sampling, f, working, pixel):
    """Data vectors [n, t, 1, 1, y, x] of the columns (U', V', W, brightness, time) in px/frame around ``pixel`` (x, y):
    U' and V' as they are seen at the working distance, W as it is seen there at the radius of the window. And which
    samples count, [t, 1, 1, y, x]: those without range (NaN) do not.

    ``images``, ``depth``, ``noise``: [t, y, x].
    """
    half = {a: sampling.axis(a).size // 2 for a in ("t", "y", "x")}
    middle = {"t": len(images) // 2, "y": pixel[1], "x": pixel[0]}
    window = tuple(slice(middle[a] - half[a], middle[a] + half[a] + 1) for a in ("t", "y", "x"))
    offset = np.meshgrid(*(np.arange(-half[a], half[a] + 1.0) for a in ("t", "y", "x")), indexing="ij")
    offset = dict(zip(("t", "y", "x"), offset, strict=True))
    seen = chain.filters_see(np.isfinite(depth), sampling)[window]
    filled = np.nan_to_num(depth, nan=1.0)
    Z, sigma = filled[window], np.nan_to_num(noise, nan=1.0)[window]
    s, w = working / f, working / radius(sampling)  # mm per px

    def motion(d):
        """``(f Gx/Z, f Gy/Z, -(x Gx + y Gy)/Z)`` in mm, x and y from the centre, times mm per px."""
        gx, gy = d["x"][window], d["y"][window]
        return [s * f * gx / Z, s * f * gy / Z, -w * (offset["x"] * gx + offset["y"] * gy) / Z]

    def moment(a):
        return np.sum(np.array(sampling.axis(a).weights) * np.arange(-half[a], half[a] + 1.0) ** 2)

    light = ["1", "x", "y", "t", *SECOND[terms]] if constraint == "taylor" else []
    vectors = []
    Zd = derivatives(filled, sampling)
    U, V, W = motion(Zd)
    scale = image_noise / (beta * sigma)
    vectors.append([scale * v for v in (U, V, W - w, *[0 * U] * len(light), Zd["t"][window])])
    kinds = [(images, 1.0)] if constraint != "grad" else []
    kinds += gradients(images, sampling) if "grad" in constraint else []
    for image, norm in kinds:
        d = derivatives(image, sampling)
        row = [*motion(d)]
        for name in light:
            value = d["i"][window].copy()
            for a in name.replace("1", ""):
                value = value * offset[a]
            if name in ("tt", "xx", "yy"):
                value = value - moment(name[0]) * d["i"][window]
            row.append(value)
        vectors.append([v / norm / np.sqrt(len(kinds)) for v in (*row, d["t"][window])])
    return [np.array(vector)[:, :, None, None] for vector in vectors], seen[:, None, None]


def structure_tensor(vectors, seen, sampling):
    """J [n, n] of what ``window_of`` returns."""
    weight = (chain.window_weights(sampling) * seen).ravel()
    flat = [vector.reshape(len(vector), -1) for vector in vectors]
    return sum((d * weight) @ d.T for d in flat)


def velocity(solved, columns, sampling, denoise, f, working, x0, y0):
    """(U, V, W) in mm/frame with covariance, brightness parameters with theirs; x0, y0 from the principal point."""
    P, cov = solved.at_centre(columns, sampling, denoise)
    T = np.array([[1, 0, x0 / f], [0, 1, y0 / f], [0, 0, 1]]) @ np.diag(
        [working / f, working / f, working / radius(sampling)]
    )
    return T @ P[:3, 0], T @ cov[0, 0][:3, :3] @ T.T, -P[3:, 0], cov[0, 0][3:, 3:]
