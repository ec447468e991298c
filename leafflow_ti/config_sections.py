"""The sections of a run's configuration, checked. Units: see ``config``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator

from leafflow_ti.config_values import (
    auto_or_integer,
    before_and_behind,
    increasing,
    integer,
    machine_memory,
    noise_or_auto,
    numbers,
    one_of,
    parse_memory,
    positive_or_auto,
)
from leafflow_ti.errors import ConfigError
from leafflow_ti.field import quantity
from leafflow_ti.filters import MAX_BLUR
from leafflow_ti.models import MODELS
from leafflow_ti.presets import REFINED_WINDOW

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

SIGMA_PER_SIZE = 19.0 / 65.0
"""Gaussian width relative to the window size in the dissertation's experiments (65 pixels, sigma 19)."""


Auto = Literal["auto"]
Preshift = Literal["auto", "uniform", "adaptive"]
_Taps = Annotated[Literal["3x1x1", "3", "5", "7"], BeforeValidator(str)]
_AutoTaps = Annotated[Literal["auto", "3x1x1", "3", "5", "7"], BeforeValidator(str)]
_TimeTaps = Annotated[Literal["auto", "2", "3x1x1", "3", "4", "5", "7", "9", "11"], BeforeValidator(str)]
_AutoOdd = Annotated[int | Auto, BeforeValidator(lambda v: auto_or_integer(v, 1, odd=True))]
_AutoCount = Annotated[int | Auto, BeforeValidator(lambda v: auto_or_integer(v, 1))]
_AutoSteps = Annotated[int | Auto, BeforeValidator(lambda v: auto_or_integer(v, 0, high=50))]
_AutoDegree = Annotated[int | Auto, BeforeValidator(lambda v: auto_or_integer(v, 5, odd=True, high=7))]
_AutoRefined = Annotated[int | Auto, BeforeValidator(lambda v: auto_or_integer(v, REFINED_WINDOW, odd=True))]
_AutoFrames = Annotated[tuple[int, int] | Auto, BeforeValidator(before_and_behind)]
_AutoRange = Annotated[tuple[float, float] | Auto, BeforeValidator(increasing)]
_Noise = Annotated[float | Auto, BeforeValidator(noise_or_auto)]
_Width = Annotated[float, Field(gt=0, allow_inf_nan=False)]

PARENT_BYTES = 96 << 20
"""Of the process that plans and starts workers, while they work: 70 MiB measured."""


class Section(BaseModel):
    """Unknown keys are errors; a checked value stays as it is."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ModelSection(Section):
    """Which parameters are estimated, and how.

    ``rows`` of the 3D fit: ``auto``, or ``u`` (the flow alone) or ``2d`` (with its derivatives along x, y) followed by
    any of ``+b5+as+at``. ``motion`` auto: rotation, where the model can. ``deformation`` growth:
    the patch may grow in its plane, one more unknown; auto: where the flows of all cameras, or the refinement, are
    there to tell. strain: in the refinement it may stretch in its plane, three more unknowns; for one camera that is
    what auto means.

    ``scale`` of the coordinates in a window, for estimators that depend on it: tls, sampson, fns. ``penalty`` on the
    residuals of the robust estimators, which estimate anew where the plain fit ``failed``, or ``all`` pixels.
    ``noise``: standard deviation of the images' noise in grey values; auto: estimated from the middle frame of the
    reference camera.
    """

    name: Annotated[str, AfterValidator(lambda v: one_of(v, ("auto", *MODELS)))] = "auto"
    motion: Motion = "auto"
    deformation: Deformation = "auto"
    rows: str = "auto"
    brightness: Brightness = "none"
    brightness_terms: BrightnessTerms = "none"
    estimator: Estimator = "tls-equilibrated"
    solver: Solver = "fast"
    scale: _Width = 1.0
    penalty: Penalty = "geman-mcclure"
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


class WindowSection(Section):
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


class FiltersSection(Section):
    """Derivative filters per axis; "auto" takes the largest set up to ``taps`` that the number of samples allows.

    ``blur``: the filters along x and y are convolved with a Gaussian of so many pixels. Texture that moves by more than
    half its wavelength per frame is aliased along time; with 1 px, 5 px/frame are measured that 7 taps alone miss.
    ``blur_time``: those along time with one of so many frames, for less noise where motion is slow and steady.
    ``taps_time`` 2 and 4, and "auto" with two frames: results lie half way between a frame and the next.

    ``prefilter`` of every image, with a Gaussian of ``sigma_pre`` pixels. On the cube under a spotlight, 8 are the best
    of 2 to 32: below, texture is lost; above, the light is left, and the dark beside the cube comes in.
    """

    taps: _Taps = "5"
    taps_time: _TimeTaps = "auto"
    taps_camera: _AutoTaps = "auto"
    blur: Annotated[float, Field(ge=0, le=MAX_BLUR, allow_inf_nan=False)] = 0.0
    blur_time: Annotated[float, Field(ge=0, le=MAX_BLUR, allow_inf_nan=False)] = 0.0
    prefilter: Prefilter = "none"
    sigma_pre: _Width = 8.0


class RangeFlowSection(Section):
    """Range flow: constraint on the intensity, its weight ``beta`` against the range beyond what their noise says, and
    ``depth``: given range maps instead of our own (results store, stack, or pattern with ``{t}``)."""

    constraint: Constraint = "taylor"
    beta: _Width = 1.0
    depth: str | None = None


class SearchSection(Section):
    """The coarse search where no single whole-pixel shift serves: lowest and highest disparity ``A,B`` as seen in the
    images [px per step along the main axis, that is x where there are columns], and the largest motion along x or y
    [px/frame]. "auto" finds the one, and searches up to 24 for the other."""

    disparity_range: _AutoRange = "auto"
    motion_range: Annotated[float | Auto, BeforeValidator(positive_or_auto)] = "auto"


class RefineSection(Section):
    """Exact refinement: at most ``steps`` Gauss-Newton steps (0: none) on every ``thin``-th pixel of a ``window``.

    "auto": ``steps`` as the preset has them for affine-scene-flow, else 0; ``window``: that of the model; ``thin``:
    some 21 samples across the window, or more where the preset says so, and every second one for one camera;
    ``spline``: the degree of the interpolation, 7 with precision f64; ``frames`` before and behind the reference frame
    that it takes: those under filters and window of the model.
    """

    steps: _AutoSteps = "auto"
    window: _AutoRefined = "auto"
    thin: _AutoCount = "auto"
    spline: _AutoDegree = "auto"
    frames: _AutoFrames = "auto"


class PlanSection(Section):
    """Resources: image rows per tile, memory limit [bytes] of all processes together, threads of each of them, and
    ``workers``, that is processes; 1: the work is done in this one. ``check_disk``: ask for the disk's room before a
    run."""

    tile: _AutoCount = "auto"
    max_memory: Annotated[int, BeforeValidator(parse_memory)] = Field(default_factory=lambda: machine_memory() // 2)
    threads: _AutoCount = "auto"
    check_disk: bool = True
    workers: Annotated[int, BeforeValidator(lambda v: integer(v, 1))] = 1

    @property
    def memory_each(self) -> int:
        """Bytes that one worker may take; several of them leave something to the process that they work for."""
        return self.max_memory if self.workers == 1 else max(0, (self.max_memory - PARENT_BYTES) // self.workers)

    def memory_for_all(self, each: int) -> int:
        """The least limit under which each worker may take so many bytes."""
        return each if self.workers == 1 else PARENT_BYTES + each * self.workers

    @property
    def limit_in_words(self) -> str:
        """Of the memory, and for how many."""
        shared = f" for {self.workers} processes" if self.workers > 1 else ""
        return f"{self.max_memory / 2**20:.0f} MiB{shared}"

    def threads_each(self, usable: int) -> int:
        """CPU threads of one worker on a machine that has so many to use."""
        return max(1, usable // self.workers) if self.threads == "auto" else int(self.threads)


class OutputSection(Section):
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
