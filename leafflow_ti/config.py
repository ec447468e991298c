"""Run configuration: what ``run.toml``, ``--set a.b=v`` and the options of ``run`` say, checked, as one frozen value.

Precedence, lowest first: defaults, preset, file, ``--set``, explicit options. Units: window sizes, sigmas, stride,
region of interest and preshift in pixels; time in frames; cameras in grid steps; memory in bytes.
"""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator, model_validator

from leafflow_ti.config_values import auto_or_integer, integer, machine_memory, noise_or_auto, numbers, parse_memory
from leafflow_ti.errors import ConfigError
from leafflow_ti.field import quantity
from leafflow_ti.filters import MAX_BLUR
from leafflow_ti.presets import (
    PRESETS,
    REFINED_MODEL,
    REFINED_SAMPLES,
    REFINED_STRIDE,
    REFINED_WINDOW,
    resolve_model,
)

Preset = Literal["fast", "balanced", "accurate"]
ModelName = Literal[
    "auto", "flow", "flow-affine", "flow-quadratic", "depth", "affine-translation", "affine", "affine-4d", "affine-5d",
    "scene-flow", "affine-scene-flow", "range-flow",
]  # fmt: skip
Motion = Literal["auto", "translation", "rotation", "acceleration"]
Brightness = Literal["none", "temporal", "spatial", "camera"]
Deformation = Literal["auto", "none", "growth", "strain"]
BrightnessTerms = Literal["none", "time", "space", "both"]
Constraint = Literal["int", "grad", "intgrad", "taylor"]
Estimator = Literal[
    "ols", "tls", "tls-equilibrated", "sampson", "fns", "for3", "robust-ols", "robust-ols-sor", "robust-tls"
]
Penalty = Literal["lorentzian", "geman-mcclure", "truncated"]
Robust = Literal["failed", "all"]
Solver = Literal["fast", "jacobi"]
Prefilter = Literal["none", "highpass", "homomorphic"]
Border = Literal["full", "clip"]
Weighting = Literal["wls", "ls"]
Precision = Literal["f32", "f64"]
Arch = Literal["auto", "cpu", "cuda", "vulkan", "metal"]

SIGMA_PER_SIZE = 19.0 / 65.0
"""Gaussian width relative to the window size in the dissertation's experiments (65 pixels, sigma 19)."""

_Auto = Literal["auto"]
_Taps = Annotated[Literal["3x1x1", "3", "5", "7"], BeforeValidator(str)]
_AutoTaps = Annotated[Literal["auto", "3x1x1", "3", "5", "7"], BeforeValidator(str)]
_AutoOdd = Annotated[int | _Auto, BeforeValidator(lambda v: auto_or_integer(v, 1, odd=True))]
_AutoCount = Annotated[int | _Auto, BeforeValidator(lambda v: auto_or_integer(v, 1))]
_AutoSteps = Annotated[int | _Auto, BeforeValidator(lambda v: auto_or_integer(v, 0, high=50))]
_AutoDegree = Annotated[int | _Auto, BeforeValidator(lambda v: auto_or_integer(v, 5, odd=True, high=7))]
_AutoRefined = Annotated[int | _Auto, BeforeValidator(lambda v: auto_or_integer(v, REFINED_WINDOW, odd=True))]
_Noise = Annotated[float | _Auto, BeforeValidator(noise_or_auto)]
_Width = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ModelSection(_Section):
    """Which parameters are estimated, and how.

    ``rows`` of the 3D fit: ``auto``, or ``u`` (the flow alone) or ``2d`` (with its derivatives along x, y) followed by
    any of ``+b5+as+at``. ``motion`` auto: rotation, where the model can. ``deformation`` growth:
    the patch may grow in its plane, one more unknown; auto: where the flows of all cameras, or the refinement, are
    there to tell. strain: in the refinement it may stretch in its plane, three more unknowns.

    ``scale`` of the coordinates in a window, for estimators that depend on it: tls, sampson, fns. ``penalty`` on the
    residuals of the robust estimators, which estimate anew where the plain fit ``failed``, or ``all`` pixels.
    ``noise``: standard deviation of the images' noise in grey values; auto: estimated from the middle frame of the
    reference camera.
    """

    name: ModelName = "auto"
    motion: Motion = "auto"
    deformation: Deformation = "auto"
    rows: str = "auto"
    brightness: Brightness = "none"
    brightness_terms: BrightnessTerms = "none"
    estimator: Estimator = "tls-equilibrated"
    solver: Solver = "fast"
    scale: _Width = 1.0
    penalty: Penalty = "lorentzian"
    robust: Robust = "failed"
    weighting: Weighting = "wls"
    noise: _Noise = "auto"

    @field_validator("rows")
    @classmethod
    def _check_rows(cls, value: str) -> str:
        first, *extra = value.split("+")
        if value != "auto" and (
            first not in ("u", "2d") or len(set(extra)) < len(extra) or not {"b5", "as", "at"}.issuperset(extra)
        ):
            raise ValueError('must be "auto", or "2d" or "u" followed by any of +b5, +as, +at, each at most once')
        return "+".join([first, *(row for row in ("b5", "as", "at") if row in extra)])


class WindowSection(_Section):
    """Gaussian windows. ``sigma`` left out or "auto": 19/65 of ``size``; sizes "auto": 5, or as many as there are;
    ``stride`` "auto": as the preset has it.

    ``border``: "full" measures where the whole window lies inside all images, "clip" up to the image border with what
    is left of the window: values there are noisier, and less exact where the surface turns or bends.
    """

    size: Annotated[int, BeforeValidator(lambda v: integer(v, 3, odd=True))] = 65
    sigma: _Width = 19.0
    size_time: _AutoOdd = "auto"
    sigma_time: _Width = 1.0
    size_camera: _AutoOdd = "auto"
    sigma_camera: _Width = 1.0
    stride: _AutoCount = "auto"
    border: Border = "full"

    @model_validator(mode="before")
    @classmethod
    def _sigma_follows_size(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and data.get("sigma", "auto") in (None, "auto"):
            size = str(data.get("size", 65))
            if size.isdecimal():  # else the size itself is reported
                return {**data, "sigma": int(size) * SIGMA_PER_SIZE}
        return data


class FiltersSection(_Section):
    """Derivative filters per axis; "auto" takes the largest set up to ``taps`` that the number of samples allows.

    ``blur``: the filters along x and y are convolved with a Gaussian of so many pixels. Texture that moves by more than
    half its wavelength per frame is aliased along time; with 1 px, 5 px/frame are measured that 7 taps alone miss.

    ``prefilter`` of every image, with a Gaussian of ``sigma_pre`` pixels. On the cube under a spotlight, 8 are the best
    of 2 to 32: below, texture is lost; above, the light is left, and the dark beside the cube comes in.
    """

    taps: _Taps = "5"
    taps_time: _AutoTaps = "auto"
    taps_camera: _AutoTaps = "auto"
    blur: Annotated[float, Field(ge=0, le=MAX_BLUR, allow_inf_nan=False)] = 0.0
    prefilter: Prefilter = "none"
    sigma_pre: _Width = 8.0


class RangeFlowSection(_Section):
    """Range flow: constraint on the intensity, its weight ``beta`` against the range beyond what their noise says, and
    ``depth``: given range maps instead of our own (results store, stack, or pattern with ``{t}``)."""

    constraint: Constraint = "taylor"
    beta: _Width = 1.0
    depth: str | None = None


class RefineSection(_Section):
    """Exact refinement: at most ``steps`` Gauss-Newton steps (0: none) on every ``thin``-th pixel of a ``window``.

    "auto": ``steps`` as the preset has them for affine-scene-flow, else 0; ``window``: that of the model; ``thin``:
    some 21 samples across the window, or more where the preset says so; ``spline``: the degree of the interpolation, 7
    with precision f64.
    """

    steps: _AutoSteps = "auto"
    window: _AutoRefined = "auto"
    thin: _AutoCount = "auto"
    spline: _AutoDegree = "auto"


class PlanSection(_Section):
    """Resources: image rows per tile, memory limit [bytes], threads."""

    tile: _AutoCount = "auto"
    max_memory: Annotated[int, BeforeValidator(parse_memory)] = Field(default_factory=lambda: machine_memory() // 2)
    threads: _AutoCount = "auto"


class OutputSection(_Section):
    """What is measured: frames ``A:B`` and region ``x0, y0, x1, y1`` (ends excluded), mask, maps; None means all."""

    frames: str | None = None
    roi: tuple[int, int, int, int] | None = None
    mask: Path | None = None
    arrays: tuple[str, ...] | None = None

    @field_validator("frames", mode="before")
    @classmethod
    def _check_frames(cls, value: object) -> object:
        if value is None:
            return value
        found = re.fullmatch(r"(\d*):(\d*)", str(value))
        if found is None or (found[1] and found[2] and int(found[1]) >= int(found[2])):
            raise ValueError("must be A:B with frame indices from 0 and A < B (B excluded; either may be left out)")
        return value

    @field_validator("roi", mode="before")
    @classmethod
    def _check_roi(cls, value: object) -> object:
        if value is None:
            return value
        form = "x0,y0,x1,y1 with 0 <= x0 < x1 and 0 <= y0 < y1 (x1, y1 excluded)"
        x0, y0, x1, y1 = numbers(value, (4,), form)
        if not (0 <= x0 < x1 and 0 <= y0 < y1):
            raise ValueError(f"must be {form}")
        return (x0, y0, x1, y1)

    @field_validator("arrays", mode="before")
    @classmethod
    def _check_arrays(cls, value: object) -> object:
        names = [name.strip() for name in value.split(",")] if isinstance(value, str) else value
        if isinstance(names, list | tuple):
            for name in names:
                try:
                    quantity(str(name))
                except KeyError as error:
                    raise ValueError(error.args[0]) from None
        return names

    def frame_range(self, n_frames: int) -> range:
        """The frame indices of ``frames`` in a sequence of ``n_frames``; ConfigError when it reaches beyond."""
        if self.frames is None:
            return range(n_frames)
        first, last = self.frames.split(":")
        frames = range(int(first or 0), int(last or n_frames))
        if not 0 <= frames.start < frames.stop <= n_frames:
            raise ConfigError(
                f"output.frames = {self.frames!r}: the capture has the frames 0:{n_frames}; give a part of them"
            )
        return frames


class RunConfig(_Section):
    """A whole run. A preset decides ``precision`` unless it is given itself, and what ``resolve`` does."""

    preset: Preset = "balanced"
    precision: Precision = "f32"
    arch: Arch = "auto"
    preshift: tuple[int, int] | _Auto = "auto"
    model: ModelSection = ModelSection()
    window: WindowSection = WindowSection()
    filters: FiltersSection = FiltersSection()
    range_flow: RangeFlowSection = RangeFlowSection()
    refine: RefineSection = RefineSection()
    plan: PlanSection = Field(default_factory=PlanSection)
    output: OutputSection = OutputSection()

    @model_validator(mode="before")
    @classmethod
    def _apply_preset(cls, data: Any) -> Any:
        chosen = PRESETS.get(str(data.get("preset", "balanced"))) if isinstance(data, Mapping) else None
        if chosen is None:
            return data  # the field itself reports what is wrong
        return {"precision": chosen.precision, **data}

    @field_validator("preshift", mode="before")
    @classmethod
    def _check_preshift(cls, value: object) -> object:
        if value == "auto":
            return value
        x, *y = numbers(value, (1, 2), 'X or X,Y per camera step, or "auto"')
        return (x, *y) if y else (x, 0)

    def to_toml(self) -> str:
        """The configuration as ``run.toml``; ``load_config`` reads the same value back."""
        values = self.model_dump(mode="json", exclude_none=True)
        top = [f"{key} = {_toml(value)}" for key, value in values.items() if not isinstance(value, dict)]
        sections = [
            f"\n[{name}]\n" + "\n".join(f"{key} = {_toml(value)}" for key, value in section.items())
            for name, section in values.items()
            if isinstance(section, dict) and section
        ]
        return "\n".join([*top, *sections]) + "\n"


def _toml(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)  # strings, numbers and lists of them are written alike in TOML


KEYWORDS: dict[str, str] = {
    **{name: name for name in ("preset", "precision", "arch", "preshift")},
    "model": "model.name",
    **{name: f"model.{name}" for name in ModelSection.model_fields if name != "name"},
    "window": "window.size",
    **{name: f"window.{name}" for name in WindowSection.model_fields if name != "size"},
    **{name: f"filters.{name}" for name in FiltersSection.model_fields},
    **{name: f"range_flow.{name}" for name in RangeFlowSection.model_fields},
    "refine": "refine.steps",
    "refine_window": "refine.window",
    "thin": "refine.thin",
    **{name: f"plan.{name}" for name in PlanSection.model_fields},
    **{name: f"output.{name}" for name in OutputSection.model_fields},
}
"""Keyword of the Python interface and option of ``run`` (with - for _) -> dotted key of the configuration."""


def load_config(
    path: str | Path | None = None, sets: Iterable[str] = (), overrides: Mapping[str, object] | None = None
) -> RunConfig:
    """The checked configuration from a TOML file, ``"a.b=v"`` settings and explicit options, the later winning.

    ``overrides``: keyword of ``KEYWORDS`` or dotted key -> value; None means not given. Paths inside the file are
    relative to the file. Raises ConfigError, one line with key, value, source and what is allowed.
    """
    given: dict[str, tuple[object, str]] = {}
    if path is not None:
        given.update(_read_file(Path(path)))
    for text in sets:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: must be KEY=VALUE, for instance --set window.size=65")
        given[key.strip()] = (_literal(value.strip()), "--set")
    for key, chosen in (overrides or {}).items():
        if chosen is not None:
            given[KEYWORDS.get(key, key)] = (chosen, "option")
    data: dict[str, Any] = {}
    for key, (item, source) in given.items():
        _check_key(key, source)
        section, dot, name = key.partition(".")
        if dot:
            data.setdefault(section, {})[name] = item
        else:
            data[key] = item
    try:
        return RunConfig.model_validate(data)
    except ValidationError as error:
        raise ConfigError("; ".join(_explain(detail, given) for detail in error.errors())) from None


def resolve(config: RunConfig, n_frames: int, n_rows: int, n_cols: int) -> RunConfig:
    """The configuration for a capture with the model, the stride and the refinement decided: none of them is "auto".

    What was given itself wins over the preset. Resolving once more changes nothing.
    """
    name = resolve_model(config.model.name, n_frames, n_rows, n_cols)
    preset, refine, window = PRESETS[config.preset], config.refine, config.window

    def decided(given: int | str, auto: int) -> int:
        return auto if given == "auto" else int(given)

    steps = decided(refine.steps, preset.steps if name == REFINED_MODEL else 0)
    size = decided(refine.window, max(window.size, REFINED_WINDOW))
    thin = max(1, size // REFINED_SAMPLES)
    thin = min(thin, preset.thin or thin)
    sections = {
        "model": {"name": name},
        "window": {"stride": decided(window.stride, max(preset.stride, REFINED_STRIDE if steps else 1))},
        "refine": {
            "steps": steps,
            "window": size,
            "thin": decided(refine.thin, thin),
            "spline": decided(refine.spline, 7 if config.precision == "f64" else 5),
        },
    }
    updated = {key: getattr(config, key).model_copy(update=values) for key, values in sections.items()}
    return config.model_copy(update=updated)


def _read_file(path: Path) -> dict[str, tuple[object, str]]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}): check --config") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not a TOML file: {error}") from None
    given: dict[str, tuple[object, str]] = {}
    for key, value in table.items():
        items = {f"{key}.{name}": v for name, v in value.items()} if isinstance(value, dict) else {key: value}
        given.update((dotted, (item, str(path))) for dotted, item in items.items())
    mask = given.get("output.mask")
    if mask is not None and isinstance(mask[0], str):
        given["output.mask"] = (path.parent / mask[0], mask[1])
    depth = given.get("range_flow.depth")
    if depth is not None and isinstance(depth[0], str):
        given["range_flow.depth"] = (str(path.parent / depth[0]), depth[1])
    return given


def _literal(text: str) -> object:
    """``text`` as a TOML value, or as the string it is: ``--set model.name=depth`` needs no quotes."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _check_key(key: str, source: str) -> None:
    sections = {name: f.annotation for name, f in RunConfig.model_fields.items()}
    names = {n: t.model_fields for n, t in sections.items() if isinstance(t, type) and issubclass(t, _Section)}
    known = [n for n in sections if n not in names] + [f"{n}.{name}" for n, fields in names.items() for name in fields]
    if key in names:
        raise ConfigError(f"{key} ({source}): is a section; give one of {', '.join(f'{key}.{n}' for n in names[key])}")
    if key not in known:
        section = key.partition(".")[0]
        near = difflib.get_close_matches(key, known, n=1) or [k for k in known if k.endswith(f".{key}")]
        allowed = ", ".join(f"{section}.{n}" for n in names[section]) if section in names else ", ".join(sections)
        hint = f"did you mean {near[0]}?" if near else f"known: {allowed}"
        raise ConfigError(f"unknown key {key!r} ({source}): {hint}")


def _explain(detail: Mapping[str, Any], given: Mapping[str, tuple[object, str]]) -> str:
    loc = [str(part) for part in detail["loc"]]
    key = next((k for k in (".".join(loc[:2]), loc[0]) if k in given), ".".join(loc))
    value, source = given.get(key, (detail["input"], "default"))
    reason = detail["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    return f"{key} = {str(value)!r} ({source}): {reason}"
