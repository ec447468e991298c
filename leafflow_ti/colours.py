"""What colours say: limits, scales and palettes of maps, of normals and of statuses, and images in these colours.

Colour limits are the 2nd and 98th percentile; colour tables are perceptually uniform, diverging about zero where a map
has both signs. Normals are coded as (red, green, blue) = (n + 1) / 2 with n = (ZX, ZY, 1) / |.|, the unit normal of
the surface that faces the camera, its third component counted towards the camera. Quick looks, reports and notebooks
take their colours from here.
"""

from __future__ import annotations

import base64
import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import MissingExtra
from leafflow_ti.status import Status

STATUS_COLOURS: dict[Status, str] = {
    Status.OK: "#5aa469",
    Status.NO_STRUCTURE: "#4c5b70",
    Status.APERTURE: "#f0c75e",
    Status.INCOHERENT: "#c4553d",
    Status.NOT_CONVERGED: "#8a3f7f",
    Status.BORDER: "#c3d0dc",
    Status.MASKED: "#1f1f24",
    Status.NOT_FINITE: "#e88fb0",
    Status.UNREFINED: "#5b9bd0",
    Status.CONTESTED: "#c9a86a",
    Status.COARSE: "#9fc3a8",
    Status.NOT_COMPUTED: "#f7f7f7",
}
"""Colour of each status in the pictures."""

LEVELS = 127
"""Colours of a map's image: steps between them cannot be seen, and half of what 8 bits of noise would take is saved."""

_SHADES = 85
"""Steps of each colour of an image without a palette, for the same reason; 255 is a multiple of it."""

Palette = NDArray[np.uint8]  # [n <= 255, 3]


@dataclass(frozen=True)
class Scale:
    """Colours of a map: ``low`` .. ``high`` along matplotlib's colour table ``colours``."""

    low: float
    high: float
    colours: str

    @classmethod
    def of(cls, values: NDArray[np.floating], *, signed: bool = False, error: bool = False) -> Scale:
        """Scale for a map, or maps of several frames, by its robust limits.

        ``signed``: diverging about zero even where all values have one sign; ``error``: values are standard errors.
        """
        low, high = robust_limits(values)
        if signed:
            high = max(-low, high)
            low = -high
        return cls(low, high, "coolwarm" if low < 0 < high else "cividis" if error else "viridis")

    def indices(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Numbers of the colours, 0 .. LEVELS - 1; LEVELS (transparent) where there is no value."""
        finite = np.isfinite(values)
        shares = (np.where(finite, values, self.low) - self.low) / (self.high - self.low)
        levels = np.clip(np.rint(shares * (LEVELS - 1)), 0, LEVELS - 1)
        return np.where(finite, levels, LEVELS).astype(np.uint8)

    def palette(self, n: int = LEVELS) -> Palette:
        """``n`` colours from the lowest to the highest; MissingExtra where matplotlib is not installed."""
        try:
            import matplotlib
        except ImportError:
            raise MissingExtra("matplotlib", "plot", "colouring maps") from None
        colours = matplotlib.colormaps[self.colours](np.linspace(0, 1, n))
        return np.asarray(np.rint(colours[:, :3] * 255), np.uint8)

    def image(self, values: NDArray[np.floating]) -> bytes:
        """The map [y, x] as a PNG file, one pixel per value, transparent where there is none."""
        return palette_png(self.indices(values), self.palette())


def robust_limits(values: NDArray[np.floating]) -> tuple[float, float]:
    """2nd and 98th percentile of the finite values, kept apart; symmetric about 0 when the signs differ."""
    finite = values[np.isfinite(values)]
    low, high = (float(v) for v in np.percentile(finite, (2, 98))) if finite.size else (0.0, 1.0)
    if low < 0 < high:
        high = max(-low, high)
        return (-high, high)
    if high - low <= 1e-6 * max(abs(low), abs(high)):  # a constant map: show it in the middle of the colours
        margin = 1e-3 * abs(high) or 1.0
        return (low - margin, high + margin)
    return (low, high)


def normal_colours(slope_x: NDArray[np.floating], slope_y: NDArray[np.floating]) -> NDArray[np.float64]:
    """Colours [y, x, 3] in 0..1 of the unit normals of a surface with the slopes ZX, ZY [y, x]; NaN where these are."""
    normal = np.stack([slope_x, slope_y, np.ones_like(slope_x)], axis=-1).astype(np.float64)
    return np.asarray((normal / np.linalg.norm(normal, axis=-1, keepdims=True) + 1) / 2)


def normal_disc(n: int) -> NDArray[np.float64]:
    """The key to ``normal_colours``: [n, n, 4], red, green, blue and opacity of all normals, seen from the camera."""
    n_x, n_y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    n_z = np.sqrt(np.clip(1 - n_x**2 - n_y**2, 0, None))
    return np.stack([(n_x + 1) / 2, (n_y + 1) / 2, (n_z + 1) / 2, (n_x**2 + n_y**2 <= 1).astype(float)], axis=-1)


def normal_image(slope_x: NDArray[np.floating], slope_y: NDArray[np.floating]) -> NDArray[np.float64]:
    """``normal_colours`` with opacity, [y, x, 4]: transparent where there is no normal."""
    colours = normal_colours(slope_x, slope_y)
    opaque = np.isfinite(colours).all(axis=-1, keepdims=True)
    return np.concatenate([np.where(opaque, colours, 0), opaque], axis=-1)


def status_colours(status: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Colours [y, x, 3] in 0..1 of codes of ``Status``."""
    table = np.zeros((256, 3))
    for code, colour in STATUS_COLOURS.items():
        table[code] = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    return np.asarray(table[status])


def status_png(status: NDArray[np.uint8]) -> bytes:
    """Codes of ``Status`` [y, x] as a PNG file in their colours."""
    codes = list(STATUS_COLOURS)
    palette = np.array([[int(STATUS_COLOURS[c][i : i + 2], 16) for i in (1, 3, 5)] for c in codes], np.uint8)
    number = np.zeros(256, np.uint8)
    number[codes] = np.arange(len(codes))
    return palette_png(number[status], palette)


def palette_png(indices: NDArray[np.uint8], palette: Palette) -> bytes:
    """A PNG file of the colours with these numbers [y, x]; ``len(palette)`` is transparent."""
    height, width = indices.shape
    table = np.concatenate([palette, [[0, 0, 0]]]).astype(np.uint8)
    opacity = bytes([255] * len(palette) + [0])
    return _png(width, height, 3, indices, [(b"PLTE", table.tobytes()), (b"tRNS", opacity)])


def rgba_png(colours: NDArray[np.floating]) -> bytes:
    """A PNG file of colours with opacity [y, x, 4] in 0..1."""
    height, width = colours.shape[:2]
    shades = np.rint(colours * _SHADES) * (255 / _SHADES)
    return _png(width, height, 6, np.rint(shades).astype(np.uint8).reshape(height, -1), [])


def data_uri(png: bytes) -> str:
    """A PNG file as the address of an image that a page holds within itself."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _png(width: int, height: int, kind: int, rows: NDArray[np.uint8], tables: list[tuple[bytes, bytes]]) -> bytes:
    """``rows`` [height, bytes of a row] of 8-bit samples as a file; ``kind``: colour type of the format."""
    unfiltered = np.zeros((height, 1), np.uint8)
    pixels = zlib.compress(np.concatenate([unfiltered, rows], axis=1).tobytes(), 9)
    head = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    chunks = [(b"IHDR", head), *tables, (b"IDAT", pixels), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )
