"""A measured field: named maps of one frame with status and pixel coordinates, and the table of their units.

Conventions: maps are ``[y, x]`` with y down and x right; ``y`` and ``x`` hold the pixel positions of the rows and
columns in the reference image (a stride above 1 leaves pixels out). Lengths are mm, times are frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.display import results_html
from leafflow_ti.errors import MissingExtra
from leafflow_ti.status import ADVICE, Status

if TYPE_CHECKING:
    import xarray

QUANTITIES: dict[str, tuple[str, str]] = {
    "disparity": ("px/step", "total disparity per camera step"),
    "depth": ("mm", "depth of the surface along the optical axis"),
    "slope_x": ("1", "surface slope dZ/dX"),
    "slope_y": ("1", "surface slope dZ/dY"),
    "velocity_x": ("mm/frame", "surface velocity along X"),
    "velocity_y": ("mm/frame", "surface velocity along Y"),
    "velocity_z": ("mm/frame", "surface velocity along Z"),
    "rotation_x": ("rad/frame", "angular velocity of the surface about X"),
    "rotation_y": ("rad/frame", "angular velocity of the surface about Y"),
    "rotation_z": ("rad/frame", "angular velocity of the surface about Z"),
    "acceleration_x": ("mm/frame²", "surface acceleration along X"),
    "acceleration_y": ("mm/frame²", "surface acceleration along Y"),
    "acceleration_z": ("mm/frame²", "surface acceleration along Z"),
    "flow_x": ("px/frame", "optical flow along x"),
    "flow_y": ("px/frame", "optical flow along y"),
    "flow_xx": ("1/frame", "derivative along x of the optical flow along x"),
    "flow_xy": ("1/frame", "derivative along y of the optical flow along x"),
    "flow_yx": ("1/frame", "derivative along x of the optical flow along y"),
    "flow_yy": ("1/frame", "derivative along y of the optical flow along y"),
    "strain_xx": ("%/frame", "strain rate in the image plane along x"),
    "strain_yy": ("%/frame", "strain rate in the image plane along y"),
    "strain_xy": ("%/frame", "shear strain rate in the image plane, half the angle between x and y"),
    "normal_flow_x": ("px/frame", "x component of the optical flow along the gradient"),
    "normal_flow_y": ("px/frame", "y component of the optical flow along the gradient"),
    "brightness_t": ("1/frame", "relative brightness change per frame"),
    "brightness_tx": ("1/(frame px)", "relative brightness change per frame, slope along x"),
    "brightness_ty": ("1/(frame px)", "relative brightness change per frame, slope along y"),
    "brightness_tt": ("1/frame²", "change of the relative brightness change per frame"),
    "brightness_sx": ("1/step", "relative brightness change per camera step along x"),
    "brightness_sy": ("1/step", "relative brightness change per camera step along y"),
    "brightness_world_x": ("1/(frame mm)", "relative brightness change per frame, slope along X on the surface"),
    "brightness_world_y": ("1/(frame mm)", "relative brightness change per frame, slope along Y on the surface"),
    "brightness_world_tt": ("1/frame²", "change of the relative brightness change per frame of a surface point"),
    "growth_rate": ("%/frame", "relative growth rate of the surface area"),
    "strain_rate_11": ("%/frame", "strain rate in the surface along its tangent in the plane of X and Z"),
    "strain_rate_22": ("%/frame", "strain rate in the surface at right angles to that tangent"),
    "strain_rate_12": ("%/frame", "shear strain rate in the surface, between the two"),
    "principal_rate_1": ("%/frame", "largest strain rate in the surface"),
    "principal_rate_2": ("%/frame", "smallest strain rate in the surface"),
    "principal_angle": ("rad", "direction of the largest strain rate, from the tangent in the plane of X and Z"),
    "area_rate": ("%/frame", "relative growth rate of the surface area, from the motion in a window"),
    "surface_strain_11": ("%/frame", "Lagrangian strain in the surface along its tangent in the plane of X and Z"),
    "surface_strain_22": ("%/frame", "Lagrangian strain in the surface at right angles to that tangent"),
    "surface_strain_12": ("%/frame", "Lagrangian shear strain in the surface, between the two"),
    "surface_principal_1": ("%/frame", "largest Lagrangian strain in the surface"),
    "surface_principal_2": ("%/frame", "smallest Lagrangian strain in the surface"),
    "surface_angle": ("rad", "direction of the largest Lagrangian strain, from the tangent in the plane of X and Z"),
    "velocity_correlation_xy": ("1", "correlation of the errors of the velocity along X and Y"),
    "velocity_correlation_xz": ("1", "correlation of the errors of the velocity along X and Z"),
    "velocity_correlation_yz": ("1", "correlation of the errors of the velocity along Y and Z"),
    "confidence": ("1", "confidence in the estimate, 0 to 1"),
    "support": ("1", "share of the window that a robust estimate rests on, 1 where the plain fit did not fail"),
    "identified": ("1", "groups of parameters that the texture determines"),
}
"""Name of a map -> (unit, long name). Every map may have a companion ``NAME_std``, its standard error, but for those
``WITHOUT_STD``."""

CORRELATIONS = ("velocity_correlation_xy", "velocity_correlation_xz", "velocity_correlation_yz")
"""Maps of the correlations between the errors of the velocity's components."""
WITHOUT_STD = (*CORRELATIONS, "confidence", "support", "identified")
IDENTIFIED: dict[str, int] = {
    name: 1 << bit
    for bit, name in enumerate(
        ("depth", "normals", "translation", "rotation", "acceleration", "brightness", "flow", "flow_gradient")
    )
}
"""Group of parameters -> its bit in the map ``identified`` (uint8)."""

MOTION_NAMES = tuple(f"{q}_{a}" for q in ("velocity", "rotation", "acceleration") for a in "xyz")
"""Maps of the unknowns (N, Ω, A)."""
STRAIN_NAMES = ("strain_rate_11", "strain_rate_22", "strain_rate_12")
"""Maps of the strain rates in the surface, which add up to the growth rate: 11 + 22."""
PRINCIPAL_NAMES = ("principal_rate_1", "principal_rate_2", "principal_angle")
"""Maps of the principal axes of these strain rates."""
SURFACE_STRAIN_NAMES = ("surface_strain_11", "surface_strain_22", "surface_strain_12")
"""Maps of the strain in the surface that follows from the motion around a pixel, not from its window's texture."""
SURFACE_PRINCIPAL_NAMES = ("surface_principal_1", "surface_principal_2", "surface_angle")
"""Maps of the principal axes of that strain."""
SURFACE_NAMES = ("area_rate", *SURFACE_STRAIN_NAMES, *SURFACE_PRINCIPAL_NAMES)
"""All maps that follow from the motion around a pixel."""
FLOW_GRADIENT_NAMES = ("flow_xx", "flow_xy", "flow_yx", "flow_yy")
"""Maps of the flow's derivatives in one camera, component by component."""
PLANE_STRAIN_NAMES = ("strain_xx", "strain_yy", "strain_xy")
"""Maps of their symmetric part: how a flat specimen that faces the camera is strained; 1 % is 10,000 µε."""


def quantity(name: str) -> tuple[str, str]:
    """Unit and long name of the map ``name``, standard errors (``NAME_std``) included.

    Raises KeyError, naming the known ones, for a name that is no map.
    """
    base = name.removesuffix("_std")
    if base not in QUANTITIES or (base != name and base in WITHOUT_STD):
        uncertain = ", ".join(known for known in QUANTITIES if known not in WITHOUT_STD)
        raise KeyError(f"no map is called {name!r}; known: {uncertain}, each also with _std; {', '.join(WITHOUT_STD)}")
    unit, long_name = QUANTITIES[base]
    return unit, long_name if base == name else f"standard error of the {long_name}"


def empty_map(name: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """The map ``name`` or ``"status"`` without a value anywhere; ``identified`` and the status are uint8."""
    if name == "status":
        return np.full(shape, Status.NOT_COMPUTED, np.uint8)
    return np.zeros(shape, np.uint8) if name == "identified" else np.full(shape, np.nan, np.float32)


def coarsened(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Correlations to 3e-5: the ten last bits of the mantissa are 0, which saves room in a compressed store.

    Not fewer bits: what matters of components that nearly depend on one another is what is left to 1.
    """
    dropped = np.uint32(10)
    bits = (np.ascontiguousarray(values, np.float32).view(np.uint32) + np.uint32(1 << 9)) >> dropped << dropped
    return np.where(np.isfinite(values), bits.view(np.float32), values)


def with_std(names: Iterable[str]) -> tuple[str, ...]:
    """The maps and their standard errors."""
    return tuple(n for base in names for n in (base, *([] if base in WITHOUT_STD else [f"{base}_std"])))


def map_attributes(name: str) -> dict[str, Any]:
    """CF attributes of the map ``name``, or of ``"status"``: units, long name, meanings of the flags."""
    if name == "status":
        return {
            "long_name": "status of the estimate",
            "flag_values": [int(code) for code in Status],
            "flag_meanings": " ".join(code.name.lower() for code in Status),
            "comment": "; ".join(f"{code.name.lower()}: {ADVICE[code]}" for code in Status),
        }
    unit, long_name = quantity(name)
    found: dict[str, Any] = {"units": unit, "long_name": long_name}
    if name == "identified":
        found |= {"flag_masks": list(IDENTIFIED.values()), "flag_meanings": " ".join(IDENTIFIED)}
    return found


def status_counts(status: NDArray[np.uint8]) -> dict[str, int]:
    """Pixels per status name, in the order of the codes; only those that occur.

    Raises ValueError for a code that ``Status`` does not have.
    """
    codes, counts = np.unique(status, return_counts=True)
    return {Status(int(code)).name.lower(): int(n) for code, n in zip(codes, counts, strict=True)}


@dataclass(frozen=True, eq=False, repr=False)
class Field(Mapping[str, NDArray[np.float32]]):
    """Maps of one frame; ``field["depth"]`` is the map, iteration gives the names.

    ``maps``: name -> float32 ``[y, x]``, names and units as in ``QUANTITIES``, standard errors as ``NAME_std``, the
    bits of ``IDENTIFIED`` as uint8;
    ``status``: uint8 ``[y, x]``, codes of ``Status``; ``y``, ``x``: int64 pixel coordinates of rows and columns;
    ``frame``: index of the reference frame; ``attrs``: how the field was made (configuration, device, timings).
    Raises ValueError when shapes disagree and KeyError for a name that is no map.
    """

    maps: Mapping[str, NDArray[np.float32]]
    status: NDArray[np.uint8]
    y: NDArray[np.int64]
    x: NDArray[np.int64]
    frame: int
    attrs: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = (self.y.size, self.x.size)
        shapes = {"status": self.status.shape, **{name: values.shape for name, values in self.maps.items()}}
        for name, found in shapes.items():
            if found != shape:
                raise ValueError(f"{name} has the shape {found}, but y and x have {shape} positions")
        for name in self.maps:
            quantity(name)

    def __getitem__(self, name: str) -> NDArray[np.float32]:
        try:
            return self.maps[name]
        except KeyError:
            raise KeyError(f"this field has no map {name!r}; it has: {', '.join(self.maps)}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self.maps)

    def __len__(self) -> int:
        return len(self.maps)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every map."""
        return (self.y.size, self.x.size)

    def measured(self) -> Field:
        """The same without the values that a coarse search alone gives (status ``coarse``), which have no errors."""
        coarse = self.status == Status.COARSE
        maps = {name: np.where(coarse, empty_map(name, ()), values) for name, values in self.maps.items()}
        return replace(self, maps=maps)

    def status_shares(self) -> dict[str, float]:
        """Share of the pixels [0..1] per status name; only those that occur."""
        return {name: n / self.status.size for name, n in status_counts(self.status).items()}

    def to_xarray(self) -> xarray.Dataset:
        """The field as a Dataset with dimensions ``y, x``, the scalar coordinate ``t`` and CF attributes.

        Raises MissingExtra where xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise MissingExtra("xarray", "xarray", "Field.to_xarray") from None
        arrays = {**self.maps, "status": self.status}
        return xarray.Dataset(
            {name: (("y", "x"), values, map_attributes(name)) for name, values in arrays.items()},
            coords={"y": self.y, "x": self.x, "t": self.frame},
            attrs=dict(self.attrs),
        )

    def _repr_html_(self) -> str:
        rows, columns = self.shape
        title = f"Field · frame {self.frame} · {rows} x {columns} (y, x)"
        return results_html(title, self.maps, self.status, lambda name: quantity(name)[0])

    def __repr__(self) -> str:
        shares = ", ".join(f"{name} {share:.1%}" for name, share in self.status_shares().items())
        rows, columns = self.shape
        names = ", ".join(name for name in self.maps if not name.endswith("_std"))
        return f"<Field frame {self.frame}, {rows} x {columns} (y, x): {names}; {shares}>"
