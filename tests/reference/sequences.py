"""Images of a random texture that moves exactly as the affine flow model says."""

import numpy as np
from scipy.linalg import expm

from leafflow_ti.synthetic.noise_texture import noise_texture, sample

PERIOD = 256.0
"""Of the texture [px]."""


def affine_sequence(flow, frames, size, wavelengths=(5.0, 20.0), amplitude=25.0, noise=0.0, seed=0):
    """Images [t, 1, 1, y, x] of ``size`` (x, y) whose flow at every time is ``flow`` [2, 3] times (1, x, y), counted
    from the middle of the image [px/frame]; grey values 100 ± ``amplitude`` (standard deviation), white ``noise``."""
    texture = noise_texture((seed, 1), PERIOD, *wavelengths)
    rate = np.zeros((3, 3))
    rate[1:] = flow
    x, y = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in size))
    at = np.stack([np.ones(x.size), x.ravel(), y.ravel()])
    images = []
    for t in np.arange(frames) - frames // 2:
        _, u, v = expm(-float(t) * rate) @ at
        images.append(sample(texture, PERIOD, u, v).reshape(x.shape))
    random = np.random.default_rng((seed, 2))
    found = 100 + amplitude * np.array(images, dtype=float) + noise * random.normal(size=(frames, *x.shape))
    return found[:, None, None]
