"""Per-pixel status: why a pixel has a value, or none, and what its user can do.

The codes are written to the results store as a CF flag variable (``flag_values``, ``flag_meanings``).
"""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """One byte per pixel; all maps are NaN but for the codes in ``HAS_VALUE``."""

    OK = 0
    NO_STRUCTURE = 1
    APERTURE = 2
    INCOHERENT = 3
    NOT_CONVERGED = 4
    BORDER = 5
    MASKED = 6
    NOT_FINITE = 7
    UNREFINED = 8
    CONTESTED = 9
    COARSE = 10
    NOT_COMPUTED = 255


ADVICE: dict[Status, str] = {
    Status.OK: "estimated",
    Status.NO_STRUCTURE: "the window holds no texture above the noise: enlarge the window, improve light or focus",
    Status.APERTURE: "texture in one direction only: values along the other are uncertain, see the standard errors",
    Status.INCOHERENT: "the window's content does not move as one surface: shrink the window, or correct the preshift",
    Status.NOT_CONVERGED: "the solver found no isolated solution: use --precision f64 or a larger window",
    Status.BORDER: "the window reaches beyond an image: a smaller one, or --border clip, measures closer to the edge",
    Status.MASKED: "outside the given mask",
    Status.NOT_FINITE: "the images hold no usable grey values here: NaN, infinite, saturated or dead pixels",
    Status.UNREFINED: "the exact refinement did not converge, fitted no better, or would mix surfaces that a robust "
    "estimate told apart: the values are those before it",
    Status.CONTESTED: "two surfaces meet here: the values are those of the one that explains the images better",
    Status.COARSE: "no window measures this pixel: disparity, depth and flow are those of the coarse search, good to a "
    "fraction of a pixel, without standard errors",
    Status.NOT_COMPUTED: "not computed yet, or outside the region of interest",
}
"""One sentence of advice for each status."""

HAS_VALUE = (Status.OK, Status.APERTURE, Status.UNREFINED, Status.CONTESTED, Status.COARSE)
"""Codes whose maps hold numbers."""
