"""Options of ``simulate``, plain strings and numbers, as fields of its scenes, which check them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from leafflow_ti.errors import UsageError


def _keep(option: str, value: Any) -> Any:
    return value


def numbers(*counts: int) -> Callable[[str, str], tuple[float, ...]]:
    """Converter of ``a,b,c`` with one of the given counts of numbers."""

    def convert(option: str, text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            raise UsageError(f"{option} {text}: must be numbers with commas between, e.g. 1,0.5") from None
        if len(values) not in counts:
            raise UsageError(f"{option} {text}: {' or '.join(map(str, counts))} numbers are needed, not {len(values)}")
        return values

    return convert


def _pair(option: str, text: str) -> tuple[float, float]:
    """``a,b``, or ``a`` for ``a,a``."""
    values = numbers(1, 2)(option, text)
    return values[0], values[-1]


def _degrees(option: str, value: float) -> float:
    return math.radians(value)


def _degrees_xyz(option: str, text: str) -> tuple[float, ...]:
    return tuple(math.radians(value) for value in numbers(3)(option, text))


def _size(option: str, text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UsageError(f"{option} {text}: must be WIDTHxHEIGHT in pixels, e.g. 301x301")
    return int(width), int(height)


def _bits(option: str, text: str) -> int | None:
    if text == "float":
        return None
    if not text.isdecimal():
        raise UsageError(f"{option} {text}: choose 8, 10, 12, 14, 16 or float")
    return int(text)


def _brightness(option: str, texts: list[str]) -> tuple[Any, ...]:
    from leafflow_ti.synthetic.material import BrightnessTerm

    terms = []
    for text in texts:
        axis, _, rest = text.partition(",")
        power, _, coefficients = rest.partition(",")
        if axis not in ("t", "sx", "sy") or not power.isdecimal():
            raise UsageError(f"{option} {text}: must be AXIS,POWER,G[,GX,GY] with AXIS t, sx or sy, e.g. t,1,0.01")
        g = numbers(1, 3)(f"{option} {axis},{power},", coefficients)
        terms.append(BrightnessTerm(axis, int(power), *g))  # type: ignore[arg-type]
    return tuple(terms)


def _percent_11_22_12(option: str, text: str) -> tuple[float, ...]:
    return tuple(value / 100.0 for value in numbers(3)(option, text))


def _growth(option: str, percent: float) -> float:
    from leafflow_ti.synthetic.plane import linear_growth

    return linear_growth(percent)


def _leaf_growth(option: str, text: str) -> tuple[float, ...]:
    """``area``, or ``along,across``, in %/frame."""
    from leafflow_ti.synthetic.leaf import isotropic

    values = numbers(1, 2)(option, text)
    return isotropic(values[0]) if len(values) == 1 else (values[0] / 100.0, values[1] / 100.0, 0.0)


def _curvature(option: str, text: str) -> tuple[float, ...]:
    """``along,across`` without a twist, or with it."""
    return (*numbers(2, 3)(option, text), 0.0)[:3]


FIELDS: dict[str, tuple[str, Callable[[str, Any], Any]]] = {
    "cameras": ("n_cols", _keep),
    "rows": ("n_rows", _keep),
    "frames": ("n_frames", _keep),
    "size": ("size", _size),
    "noise": ("noise", _keep),
    "seed": ("seed", _keep),
    "bits": ("bits", _bits),
    "focal_px": ("f_px", _keep),
    "principal_px": ("principal_px", numbers(2)),
    "baseline_mm": ("baseline_mm", _pair),
    "velocity": ("velocity", numbers(3)),
    "omega_deg": ("omega", _degrees_xyz),
    "rotation_centre_mm": ("rotation_centre", numbers(3)),
    "acceleration": ("acceleration", numbers(3)),
    "wavelength_mm": ("wavelengths_mm", _pair),
    "offset": ("offset", _keep),
    # plane
    "slope_x": ("zx", _keep),
    "slope_y": ("zy", _keep),
    "amplitude": ("amplitude", _keep),
    "alpha_deg": ("alpha", _degrees),
    "beta_deg": ("beta", _degrees),
    "brightness": ("brightness", _brightness),
    "growth": ("growth", _growth),
    "strain": ("strain", _percent_11_22_12),
    "texture": ("texture", _keep),
    # cube
    "edges_mm": ("edges_mm", numbers(3)),
    "orientation_deg": ("orientation", _degrees_xyz),
    "contrast": ("contrast", _keep),
    "background": ("background", _keep),
    "texture_seed": ("texture_seed", _keep),
    "supersampling": ("supersampling", _keep),
    "light": ("light", _keep),
    "light_mm": ("light_mm", numbers(3)),
    "light_target_mm": ("light_target_mm", numbers(3)),
    "light_cone_deg": ("light_cone", _degrees),
    "ambient_share": ("ambient_share", _keep),
    # leaf
    "turn_deg": ("turn", _degrees),
    "curvature": ("curvature", _curvature),
    "half_mm": ("half_mm", _pair),
    "pointed": ("pointed", _keep),
    "leaf_growth": ("growth", _leaf_growth),
    # leaves
    "leaves": ("leaves", _keep),
    "disparity_px": ("disparity_px", numbers(2)),
    "motion_px": ("motion_px", _keep),
    "wavelength_px": ("wavelengths_px", _pair),
    "light_change": ("light_change", numbers(3)),
    "layout_seed": ("layout_seed", _keep),
}
"""Parameter of a command -> field of the scene and how the value is read."""
