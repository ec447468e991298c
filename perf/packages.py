"""The 2D and 3D structure tensor beside the packages that compute nothing else: structure-tensor and scikit-image.

Same filters, same windows: a filter set is data, so ours becomes theirs. structure-tensor differentiates with sampled
Gaussian derivatives (``sigma``) and sums over Gaussians (``rho``), scikit-image differentiates with Sobel's filter (8
times the derivative) and sums over Gaussians; both cut Gaussians off at four sigmas. The results must then agree as
far as single precision goes. Ours computes more beside them: window mass, smoothness of the texture and level.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, uniform_filter  # type: ignore[import-untyped]

from leafflow_ti.filters import FilterSet
from leafflow_ti.models import Column, ColumnSet
from leafflow_ti.runtime import Device
from leafflow_ti.sampling import AxisSampling, Sampling
from perf.bench import median_seconds, plain_tensor
from perf.figures import Figure

Array = NDArray[Any]
TRUNCATE = 4.0
SAME = 2e-5
"""Largest difference of J[i, j] relative to sqrt(J[i, i] J[j, j]): single precision on both sides, sums of 65² samples
of either sign, and images whose level is some ten times their contrast."""
SIGMA = 0.75
"""Of the derivative filters: 7 taps."""
RHO = {2: 8.0, 3: 2.0}
"""Of the windows: 65 pixels; 17 pixels and frames."""


@dataclass(frozen=True)
class Settings:
    """Sides of the images, and of the volume: as many frames as its window needs to be full a few times."""

    image_px: int = 1024
    volume_px: int = 300
    frames: int = 32
    repeats: int = 3


def _gaussian(sigma: float) -> Array:
    """Weights of a Gaussian as the packages sample it."""
    radius = int(TRUNCATE * sigma + 0.5)
    impulse = np.zeros(2 * radius + 1)
    impulse[radius] = 1
    return np.asarray(gaussian_filter1d(impulse, sigma, truncate=TRUNCATE, mode="constant"))


def _gaussian_filters(sigma: float) -> FilterSet:
    """Sampled Gaussian and its derivative, as correlation kernels."""
    smooth = _gaussian(sigma)
    offset = np.arange(len(smooth)) - len(smooth) // 2
    return FilterSet("gaussian", tuple((smooth * offset / sigma**2).tolist()), tuple(smooth.tolist()))


SOBEL = FilterSet("sobel", (-1.0, 0.0, 1.0), (1.0, 2.0, 1.0))
"""Scaled as scikit-image has it: 8 times the derivative in 2D."""


def _sampling(filters: FilterSet, rho: float, time: bool) -> Sampling:
    axis = AxisSampling(filters, tuple(_gaussian(rho).tolist()))
    return Sampling(axis, axis, t=axis if time else AxisSampling())


def _columns(channels: str) -> ColumnSet:
    return ColumnSet(tuple(Column.of(c) for c in channels), 1)


def _scene(*shape: int) -> Array:
    """A smooth random texture with a level, float32."""
    noise = np.random.default_rng(0).standard_normal(shape)
    smooth = uniform_filter(noise, 3)
    return (100 + 10 * smooth / smooth.std()).astype(np.float32)


def _difference(ours: Array, theirs: Array, diagonal: dict[tuple[int, int], int]) -> float:
    """Largest difference of two stacks of entries, relative to the sizes of their columns."""
    worst = 0.0
    for (i, j), entry in diagonal.items():
        size = np.sqrt(theirs[diagonal[i, i]] * theirs[diagonal[j, j]])
        worst = max(worst, float((np.abs(ours[entry] - theirs[entry]) / size).max()))
    return worst


@dataclass(frozen=True)
class _Peer:
    """A package's function on an image, its entries in the order of ours, and the filters that it uses."""

    name: str
    module: str
    filters: FilterSet
    call: Callable[[Any, Array, float], Any]
    order: tuple[int, ...]


# Ours are packed by rows of the lower triangle: xx, xy, yy, xt, yt, tt.
PEERS_2D = (
    _Peer(
        "structure-tensor, 2D", "structure_tensor", _gaussian_filters(SIGMA),
        lambda m, image, rho: m.structure_tensor_2d(image, SIGMA, rho), (1, 2, 0),
    ),
    _Peer(
        "scikit-image, 2D", "skimage.feature", SOBEL,
        lambda m, image, rho: np.stack(m.structure_tensor(image, rho, mode="nearest", order="rc")), (2, 1, 0),
    ),
)  # fmt: skip
PEERS_3D = (
    _Peer(
        "structure-tensor, 3D", "structure_tensor", _gaussian_filters(SIGMA),
        lambda m, volume, rho: m.structure_tensor_3d(volume, SIGMA, rho), (0, 3, 1, 4, 5, 2),
    ),
)  # fmt: skip


def measure(device: Device, settings: Settings) -> tuple[list[Figure], list[str]]:
    """Figures of every package that is installed; a line for each that is not."""
    figures: list[Figure] = []
    absent: list[str] = []
    for peers, columns in ((PEERS_2D, "xy"), (PEERS_3D, "xyt")):
        for peer in peers:
            try:
                module = importlib.import_module(peer.module)
            except ImportError:
                absent.append(f"{peer.name}: skipped, {peer.module.split('.')[0]} is not installed")
            else:
                figures += _compare(device, settings, peer, module, columns)
    return figures, absent


def _compare(device: Device, settings: Settings, peer: _Peer, module: Any, channels: str) -> list[Figure]:
    volume = len(channels) == 3
    rho = RHO[len(channels)]
    sampling = _sampling(peer.filters, rho, volume)
    side = settings.volume_px if volume else settings.image_px
    halo = sampling.x.radius + sampling.x.filter_radius
    inner = side - 2 * halo
    frames = _scene(settings.frames, side, side) if volume else _scene(side, side)[None]
    image = frames if volume else frames[0]
    theirs_s = median_seconds(lambda: peer.call(module, image, rho), settings.repeats)
    # One frame makes a tensor in 2D: repeat it; the first is compiled away.
    pushed = frames if volume else np.repeat(frames, settings.repeats + 1, axis=0)
    ours_s, ours = plain_tensor(device, _columns(channels), sampling, pushed, inner, inner)
    found = np.asarray(peer.call(module, image, rho))[list(peer.order)]
    if volume:
        found = found[:, settings.frames - 1 - sampling.t.radius]
    found = found[:, halo : halo + inner, halo : halo + inner]
    lower = [(i, j) for i in range(len(channels)) for j in range(i + 1)]
    places = {pair: k for k, pair in enumerate(lower)}
    ours_us, theirs_us = 1e6 * ours_s / inner**2, 1e6 * theirs_s / image.size
    return [
        Figure(f"{peer.name}: package", theirs_us, "us/px"),
        Figure(f"{peer.name}: ours", ours_us, "us/px"),
        Figure(f"{peer.name}: package over ours", theirs_us / ours_us, "x", low=1.0),
        Figure(f"{peer.name}: largest difference", _difference(ours, found, places), "", SAME),
    ]
