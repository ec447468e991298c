"""What a camera rig will measure, before it is built: standard errors of every map from geometry, texture and noise.

The textures are random with a known spectrum; what windows of them hold on average (``expected``) goes through the
program's own estimators and covariances, those of the images' noise. What the models themselves leave out on curved or
quickly turning surfaces comes on top. The exact refinement's errors follow from the same texture: the covariance of
weighted least squares on the moving patch with unknown texture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError, UsageError
from leafflow_ti.expected import Array, ExpectedTexture, Spectrum, flow_parameters_of
from leafflow_ti.field import MOTION_NAMES, STRAIN_NAMES
from leafflow_ti.growth import INPUTS, growth_maps
from leafflow_ti.models import ColumnSet, TensorLayout
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.refine_plan import Refinement
from leafflow_ti.runtime import Device, start
from leafflow_ti.splines import PREFILTER_SIGMA
from leafflow_ti.stages.estimate import EstimateStage, View
from leafflow_ti.stages.problem import Problem
from leafflow_ti.stays import plane_of
from leafflow_ti.synthetic.exact_flow import flow_parameters, preshifted_flow_parameters
from leafflow_ti.synthetic.geometry import plane_axes
from leafflow_ti.synthetic.moving_patch import Views, directions, pulled_back, window
from leafflow_ti.synthetic.plane import PlaneScene
from leafflow_ti.synthetic.rig import rays_of

AROUND = 1
"""Output pixels around the one that is predicted: growth is told from differences between neighbours."""
LEAST_SLOPE = 0.01
"""No surface stands exactly upright; of one that does, the affine rows of a flow tell no rotation about X or Y."""
LEAST_CORRELATION = 1e-3
"""Noise of samples is taken as independent below."""


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Cameras, the surface before them, and its texture; pairs are (x, y).

    ``f_px``, ``size`` of the images [px]; ``baseline_mm`` between neighbouring cameras, of which there are ``cols`` and
    ``rows``; ``frames`` of the sequence, ``interval_s`` apart. ``at``: the pixel, from the principal point; the farther
    from it, the more of the uncertain velocity along Z enters those along X and Y. The surface there: ``distance_mm``,
    ``slopes`` dZ/dX, dZ/dY, ``velocity`` [mm/frame], ``rotation`` [rad/frame]. ``noise`` and ``contrast``: standard
    deviations of the images' noise and texture, ``mean`` their grey value. ``wavelengths_px``: shortest and longest of
    the texture, as an image of the upright surface shows it; ``exponent``: power falls as frequency^-exponent per area
    of the frequency plane (2: as much in every octave). Raises UsageError for values that make no sense.
    """

    f_px: float
    baseline_mm: tuple[float, float]
    distance_mm: float
    cols: int = 9
    rows: int = 1
    size: tuple[int, int] = (1600, 1200)
    frames: int = 9
    interval_s: float | None = None
    noise: float = 1.0
    contrast: float = 20.0
    mean: float = 100.0
    wavelengths_px: tuple[float, float] = (4.0, 32.0)
    exponent: float = 2.0
    slopes: tuple[float, float] = (0.0, 0.0)
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    at: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        positive = {
            "focal length": self.f_px, "distance": self.distance_mm, "noise": self.noise, "contrast": self.contrast,
            "columns of cameras": self.cols, "rows of cameras": self.rows, "frames": self.frames,
        }  # fmt: skip
        for name, value in positive.items():
            if not 0 < value < math.inf:
                raise UsageError(f"{name} = {value:g}: must be positive and finite")
        shortest, longest = self.wavelengths_px
        if not 2.0 <= shortest < longest < math.inf:
            raise UsageError(
                f"wavelengths {shortest:g} to {longest:g} px: give the shortest, at least 2 px, then a longer one"
            )
        for axis, count, step in zip("xy", (self.cols, self.rows), self.baseline_mm, strict=True):
            if count > 1 and not 0 < abs(step) < math.inf:
                raise UsageError(f"baseline along {axis} = {step:g} mm with {count} cameras: give the camera step")
        if self.interval_s is not None and not 0 < self.interval_s < math.inf:
            raise UsageError(f"interval = {self.interval_s:g} s: must be positive and finite")

    @property
    def mm_per_px(self) -> float:
        """Width on the surface of one pixel [mm]."""
        return self.distance_mm / self.f_px

    @property
    def disparity(self) -> tuple[float, float]:
        """Total disparity [px/step] along x and y; 0 along an axis with one camera."""
        steps = zip(self.baseline_mm, (self.cols, self.rows), strict=True)
        x, y = (-self.f_px * step / self.distance_mm if count > 1 else 0.0 for step, count in steps)
        return x, y

    @property
    def preshift(self) -> tuple[int, int]:
        """The disparity in whole pixels, which is taken out beforehand."""
        return round(self.disparity[0]), round(self.disparity[1])

    @property
    def depth_range_mm(self) -> tuple[float, float]:
        """Depths whose disparity lies within 1 px of the preshift, along the axis with the larger one."""
        k = 0 if abs(self.disparity[0]) >= abs(self.disparity[1]) else 1
        lever, whole = self.f_px * abs(self.baseline_mm[k]), abs(self.preshift[k])
        return lever / (whole + 1), lever / (whole - 1) if whole > 1 else math.inf

    @property
    def scene(self) -> PlaneScene:
        """The plane patch before the cameras, without texture to speak of."""
        return PlaneScene(
            f_px=self.f_px, baseline_mm=(self.baseline_mm[0] or 1.0, self.baseline_mm[1] or 1.0), n_cols=self.cols,
            n_rows=self.rows, n_frames=self.frames, size=(1, 1),
            centre=(self.at[0] * self.mm_per_px, self.at[1] * self.mm_per_px, self.distance_mm),
            zx=self.tilt[0], zy=self.tilt[1], velocity=self.velocity, omega=self.rotation,
        )  # fmt: skip

    @property
    def tilt(self) -> tuple[float, float]:
        """The slopes that are predicted for: ``LEAST_SLOPE`` for a surface that stands upright."""
        return self.slopes if max(map(abs, self.slopes)) >= LEAST_SLOPE else (LEAST_SLOPE, LEAST_SLOPE)

    @property
    def surface_contrast(self) -> float:
        """Standard deviation of the texture before the pixels average it, such that images have ``contrast``."""
        return self.contrast / self._spectrum(1.0, (0.0, 0.0)).contrast

    @property
    def spectrum(self) -> Spectrum:
        """Of the middle camera's image of the sloped surface."""
        return self._spectrum(self.surface_contrast, self.slopes)

    def _spectrum(self, contrast: float, slopes: tuple[float, float]) -> Spectrum:
        """Of a surface with this contrast and these slopes."""
        shortest, longest = (length * self.mm_per_px for length in self.wavelengths_px)
        zx, zy = slopes
        x, y = (position / self.f_px for position in self.at)
        # Where the ray of a pixel beside it meets the plane: dZ = Z (ZX dx + ZY dy) / (1 - ZX x - ZY y) / f.
        along = self.mm_per_px / (1.0 - zx * x - zy * y)
        depth = along * np.array([zx, zy])
        across = self.mm_per_px * np.eye(2) + np.outer([x, y], depth)
        per_px = plane_axes(zx, zy)[:, :2].T @ np.vstack([across, depth])
        return Spectrum.of((shortest, longest), self.exponent, contrast, per_px)


@dataclass(frozen=True)
class Prediction:
    """``errors``: standard error of each map, in its unit; ``start``: of the model before the refinement (the same
    where nothing is refined); ``window``: side [px]; ``plan``: what would be run."""

    rig: Rig
    plan: Plan
    errors: Mapping[str, float]
    start: Mapping[str, float]

    @property
    def groups(self) -> dict[str, float]:
        """One number each: depth [mm], normals [rad], velocity [mm/frame], growth [%/frame], as far as measured."""
        found = {}
        for name, parts, scale in (
            ("depth", ("depth",), 1.0),
            ("normals", ("slope_x", "slope_y"), self._normal_per_slope),
            ("velocity", MOTION_NAMES[:3], 1.0),
            ("growth", ("growth_rate",), 1.0),
        ):
            values = [self.errors[part] for part in parts if part in self.errors]
            if values:
                found[name] = scale * math.sqrt(sum(value**2 for value in values))
        return found

    @property
    def _normal_per_slope(self) -> float:
        """Angle of the normal per change of the slopes, on average over their directions."""
        c2 = 1 + self.rig.slopes[0] ** 2 + self.rig.slopes[1] ** 2
        return math.sqrt((1 / c2 + 1 / c2**2) / 2)


def plan_rig(rig: Rig, config: RunConfig | None = None) -> Prediction:
    """Standard errors of one output pixel.

    ``config``: model, windows, preshift, refinement, as for ``run``. Raises ConfigError where it does not fit the rig.
    """
    config = config or RunConfig()
    plan = _plan(rig, config)
    if plan.ranges is not None or not plan.problem.camera_axes:
        raise ConfigError(
            f"model '{plan.model}': rigs are planned for models that measure depth from cameras: choose depth, "
            "affine-4d, affine-5d, scene-flow or affine-scene-flow"
        )
    # Expected tensors are free of rounding, unlike sums of images: double precision shows the noise alone.
    start_errors = _model_errors(rig, plan, start(config.arch, "f64"))
    errors = dict(start_errors)
    if plan.refine:
        errors |= refined_errors(rig, plan.refine)
    return Prediction(rig, plan, errors, start_errors)


def _plan(rig: Rig, config: RunConfig) -> Plan:
    """The plan of a run on such images, of a few pixels in their middle."""
    width, height = rig.size
    nothing = np.broadcast_to(np.zeros((), np.float32), (rig.frames, rig.rows, rig.cols, height, width))
    # Images are of no concern: the predicted pixel stands in the middle of some, the principal point elsewhere.
    x, y = width // 2, height // 2
    baseline = (rig.baseline_mm[0] if rig.cols > 1 else 0.0, rig.baseline_mm[1] if rig.rows > 1 else 0.0)
    geometry = Geometry(rig.f_px, (float(x - rig.at[0]), float(y - rig.at[1])), baseline)
    capture = capture_from_array(nothing, geometry, rig.interval_s)
    model = config.model.model_copy(update={"noise": rig.noise})
    output = config.output.model_copy(
        update={"roi": (x, y, x + 1, y + 1), "frames": None, "mask": None, "arrays": None}
    )
    preshift = rig.preshift if isinstance(config.preshift, str) else config.preshift
    found = make_plan(capture, config.model_copy(update={"model": model, "output": output, "preshift": preshift}))
    stride, reach = found.x.step, AROUND * found.x.step
    around = tuple(range(middle - reach, middle + reach + 1, stride) for middle in (x, y))
    return replace(found, x=around[0], y=around[1])


def _model_errors(rig: Rig, plan: Plan, device: Device) -> dict[str, float]:
    """Standard errors of the model's maps, by the program's own per-pixel stages on expected tensors."""
    from leafflow_ti.kernels.maps import Output

    side, lanes = 2 * AROUND + 1, device.dense.lanes
    pitch = -(-side // lanes) * lanes
    view = View(
        rig.f_px, plan.geometry.principal_px, plan.geometry.baseline_mm, plan.preshift, plan.x[0], plan.y[0],
        plan.x.step, side, side, pitch,
    )  # fmt: skip
    stage = EstimateStage(device, plan.problem, plan.layout, view, plan.differences)
    planes = np.concatenate(_expected_planes(rig, plan))
    tensors = device.array(np.repeat(planes, side * pitch), "storage")
    found = stage(tensors)

    def of(name: str, plane: int = 0) -> Any:
        return found[plane_of(name) + plane]

    errors = {
        name: float(of(name, Output.STD)[AROUND, AROUND])
        for name in plan.measured
        if name in ("disparity", "depth", "slope_x", "slope_y", *MOTION_NAMES)
    }
    if plan.differences:
        rays = [
            (np.array(positions) - centre) / rig.f_px
            for positions, centre in zip((plan.x, plan.y), plan.geometry.principal_px, strict=True)
        ]
        # Every pixel has the tensor of the one in the middle, and so its depth: the surface is known better.
        depth = rig.scene.intersect(rays_of(*rays), np.zeros(3), 0.0)[..., 2]
        maps = {name: of(name) for name in INPUTS} | {"depth": depth}
        growth = growth_maps(maps, plan.y, plan.x, rig.f_px, plan.geometry.principal_px, plan.problem.sampling)
        errors["growth_rate"] = float(growth["growth_rate_std"][AROUND, AROUND])
    return errors


def _expected_planes(rig: Rig, plan: Plan) -> list[Array]:
    """Tensors of the reference model and of every camera's own flow, one after the other."""
    problem, spectrum = plan.problem, rig.spectrum
    shift, parameters = _reference_flow(rig, problem, plan.preshift)
    texture = ExpectedTexture.of(spectrum, problem.sampling, problem.columns, shift, rig.noise, rig.mean)
    found = [texture.planes(plan.layout, parameters)]
    if own := problem.own_flows:
        # Smoothing along time blurs what moves, in every camera alike.
        texture = ExpectedTexture.of(spectrum, own.sampling, own.columns, {"t": shift["t"]}, rig.noise, rig.mean)
        layout = TensorLayout.of(own.columns)
        found += [texture.planes(layout, _own_parameters(rig, own.columns, step, plan.preshift)) for step in own.steps]
    return found


def _reference_flow(
    rig: Rig, problem: Problem, preshift: tuple[int, int]
) -> tuple[dict[str, tuple[float, float]], Array]:
    """How the texture moves along camera and time axes [px], and the parameters of the reference's columns."""
    exact = preshifted_flow_parameters(rig.scene, *rig.at, (float(preshift[0]), float(preshift[1])))
    nu, b, u, a = exact["nu"], exact["b"], exact["u"], exact["a"]
    shift = {"sx": (float(nu[0]), 0.0), "sy": (0.0, float(nu[1])), "t": (float(u[0]), float(u[1]))}
    fields = {"sx": {"x": (nu[0], b[0])}, "sy": {"y": (nu[1], b[1])}, "t": {"x": (u[0], a[0]), "y": (u[1], a[1])}}
    sampled = {axis: shift[axis] for axis in problem.columns.solutions}
    return sampled, flow_parameters_of(problem.columns, fields)


def _own_parameters(rig: Rig, columns: ColumnSet, step: tuple[int, int], preshift: tuple[int, int]) -> Array:
    """Flow of the camera ``step`` (x, y) steps away, at the pixel nearest to where it sees the patch."""
    scene = rig.scene
    camera = np.array([step[0] * scene.baseline_mm[0], step[1] * scene.baseline_mm[1], 0.0])
    x, y, z = (np.array(scene.centre) - camera).tolist()
    column, row = (
        rig.at[k] + round(-camera[k] / rig.mm_per_px - preshift[k] * step[k]) + preshift[k] * step[k] for k in (0, 1)
    )
    exact = flow_parameters(replace(scene, centre=(x, y, z)), column, row)
    u, a = exact["u"], exact["a"]
    return flow_parameters_of(columns, {"t": {"x": (u[0], a[0]), "y": (u[1], a[1])}})


def refined_errors(rig: Rig, plan: Refinement) -> dict[str, float]:
    """Standard errors of the refinement's unknowns.

    ``Cov = A^-1 B A^-1``: A is the normal matrix of the window, B the covariance of its right-hand side, of noise that
    the prefilter has correlated over the texture's own correlation.
    """
    scene, along = rig.scene, directions(plan.motion, plan.modes)
    steps = np.array([(k * scene.baseline_mm[0], j * scene.baseline_mm[1]) for k, j in plan.cameras])
    times = np.repeat(np.array(plan.frames, float), len(steps))
    views = Views(rig.f_px, *rig.at, np.tile(steps, (len(plan.frames), 1)), times)
    state = np.array([rig.distance_mm, *rig.tilt, *rig.velocity, *rig.rotation, *np.zeros(6)])
    offsets = window(plan.size, plan.thin)
    jacobian = np.stack([pulled_back(views, state, offsets, k, along) for k in range(len(times))])
    jacobian -= jacobian.mean(axis=0)  # what all images share is the texture, which is unknown
    weights = np.exp(-0.5 * np.sum(offsets**2, axis=1) / plan.sigma**2)
    gradient, correlated = _gradients(rig.spectrum, plan.thin)
    A = np.einsum("s,ksim,ij,ksjn->mn", weights, jacobian, gradient, jacobian, optimize=True)
    B = np.einsum("s,ksim,ij,ksjn->mn", weights**2, jacobian, correlated, jacobian, optimize=True)
    scale = 1 / np.sqrt(np.diag(A))
    inverse = np.linalg.inv(A * np.outer(scale, scale)) * np.outer(scale, scale)
    noise = rig.noise**2 / (4 * math.pi * PREFILTER_SIGMA**2)
    std = np.sqrt(noise * np.diag(inverse @ B @ inverse))
    errors = dict(zip(("depth", "slope_x", "slope_y", *MOTION_NAMES[: plan.motion]), std.tolist(), strict=False))
    strain = 100.0 * std[3 + plan.motion :]
    if plan.modes == 1:
        errors["growth_rate"] = 2.0 * float(strain[0])
    elif plan.modes == 3:
        errors |= dict(zip(STRAIN_NAMES, strain.tolist(), strict=True))
        pair = (inverse @ B @ inverse)[3 + plan.motion : 5 + plan.motion, 3 + plan.motion : 5 + plan.motion]
        errors["growth_rate"] = 100.0 * math.sqrt(noise * float(pair.sum()))
    return errors


def _gradients(spectrum: Spectrum, thin: int) -> tuple[Array, Array]:
    """Of the smoothed texture: ``E[∇T ∇Tᵀ]``, and the same summed over samples d apart times their noise's
    correlation, [2, 2] each."""
    omega = spectrum.omega
    power = spectrum.power * np.exp(-np.sum(omega**2, axis=1) * PREFILTER_SIGMA**2)
    reach = int(2 * PREFILTER_SIGMA * math.sqrt(-math.log(LEAST_CORRELATION)) // thin)
    lags = thin * np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    shared = np.exp(-np.sum(lags**2, axis=1) / (4 * PREFILTER_SIGMA**2))
    plain = np.einsum("n,ni,nj->ij", power, omega, omega)
    correlated = np.einsum("n,ni,nj->ij", power * (np.cos(omega @ lags.T) @ shared), omega, omega)
    return plain, correlated
