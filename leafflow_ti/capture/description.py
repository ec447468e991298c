"""``capture.toml``: which files are which image, and the geometry that turns pixels into millimetres.

    [images]
    pattern = "cam_{sx:02d}/frame_{t:02d}.tif"   # fields t, sx, sy, or one running index i; {t} alone: any digits
    # or path = "stack.tif"
    # axes = "t sx y x"               axes of the pages in each file, slowest first
    # order = "sy sx"                 axes that the running index i counts, slowest first
    # shape = { sy = 9, sx = 9 }      sizes of the axes in `axes` and `order`, where the file does not state them
    # select = { t = [0, 8] }         first and last value (and step) of a field, instead of all that is found
    # channel = "luminance"           colour to grey: luminance (.299 R + .587 G + .114 B), mean, red, green, blue,
    #                                 or the index of a stored sample
    # bit_depth = 12                  significant bits where the file states more, e.g. 12 padded to 16
    # saturated = 250                 grey value from which on a pixel does not count; "auto": the largest one of the
    #                                 bit depth. Without it all count
    # dead = "dead.png"               non-zero: dead pixels of the sensor; "dead_{sx}.png" (fields sx, sy): of each one
    [camera]
    focal_length_px = 2800.0          # or focal_length_mm and pixel_pitch_mm
    principal_point_px = [319.5, 239.5]          # default: image centre (W-1)/2, (H-1)/2
    # or calibration = "camera.yml"   OpenCV's file; "cam_{sx}.yml" (fields sx, sy): one for each camera. Images are
    #                                 undistorted and rectified while they are read, see ``calibration``
    [grid]
    baseline_mm = [5.0, 5.0]          # x, y step of the camera for each step of sx, sy; one number for a 1D grid
    disparity_offset_px = [0.0, 0.0]  # total disparity = disparity seen in the images + this, per step
    positions_mm = [[0.0, 0.01], [5.02, 0.0]]    # measured x, y of every camera from any origin, rows one after the
                                      # other; baseline_mm is then the nominal step that results count in
    [time]
    interval_s = 120.0
    stamps_s = [0.0, 120.0, 245.0]    # measured time of every frame; interval_s defaults to the median step
    # or stamps = "times.txt"         # a file with one number a line

Camera indices ascend with sx and sy as numbers, whatever they start at; a baseline is negative where the camera moves
to the left or up with them. Unknown keys are errors.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StrictInt,
    StrictStr,
    ValidationError,
    field_validator,
    model_validator,
)

from leafflow_ti.capture.channels import CHANNEL_NAMES
from leafflow_ti.capture.pattern import AXES, Pattern
from leafflow_ti.errors import ConfigError, InputError

FILE_NAME = "capture.toml"


def _as_list(value: object) -> object:
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else value


_Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
_PerAxis = Annotated[tuple[_Finite, ...], BeforeValidator(_as_list), Field(min_length=1, max_length=2)]


def _of_cameras(name: str | None) -> str | None:
    """The name of a file that may be one for each camera."""
    other = set(Pattern.parse(name).fields) - {"sx", "sy"} if name is not None else set()
    if other:
        raise ValueError(f"field '{{{min(other)}}}': one file for all cameras, or the fields sx and sy")
    return name


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Images(_Section):
    """Where the images are, and how one grey image is made of each file or page."""

    pattern: StrictStr | None = None
    path: StrictStr | None = None
    axes: StrictStr | None = None
    order: StrictStr | None = None
    shape: dict[StrictStr, Annotated[StrictInt, Field(ge=1)]] = {}
    select: dict[StrictStr, tuple[StrictInt, ...]] = {}
    channel: Any = "luminance"
    bit_depth: Annotated[StrictInt, Field(ge=1, le=32)] | None = None
    saturated: _Finite | Literal["auto"] | None = None
    dead: StrictStr | None = None

    @property
    def dead_pattern(self) -> Pattern | None:
        """The name of the file of dead pixels, with a field for each axis of cameras that it is given for."""
        return None if self.dead is None else Pattern.parse(self.dead)

    @field_validator("dead")
    @classmethod
    def _one_dead_file_per_camera(cls, value: str | None) -> str | None:
        return _of_cameras(value)

    @property
    def file_pattern(self) -> Pattern:
        """The pattern; a stack's path is one without fields, its braces mean themselves."""
        if self.pattern is not None:
            return Pattern.parse(self.pattern)
        return Pattern.parse((self.path or "").replace("{", "{{").replace("}", "}}"))

    @property
    def page_axes(self) -> tuple[str, ...]:
        """Axes of the pages inside each file, slowest first."""
        return tuple((self.axes or "y x").split())[:-2]

    @property
    def index_axes(self) -> tuple[str, ...]:
        """Axes that the running index ``{i}`` counts, slowest first."""
        return tuple((self.order or "").split())

    @field_validator("channel")
    @classmethod
    def _known_channel(cls, value: object) -> object:
        if value in CHANNEL_NAMES or (isinstance(value, int) and not isinstance(value, bool) and value >= 0):
            return value
        raise ValueError(f"use one of {', '.join(CHANNEL_NAMES)}, or the index of a sample")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.pattern is None) == (self.path is None):
            raise ValueError("give either pattern or path")
        if self.axes is not None and self.axes.split()[-2:] != ["y", "x"]:
            raise ValueError(f'axes = "{self.axes}" must end in y x, e.g. "t sx y x"')
        fields = self.file_pattern.fields
        if ("i" in fields) != bool(self.index_axes):
            raise ValueError('the field {i} and order = "sy sx" need each other')
        named = [*(field for field in fields if field != "i"), *self.index_axes, *self.page_axes]
        for axis in named:
            if axis not in AXES:
                raise ValueError(f"axis '{axis}' is unknown, the axes are {', '.join(AXES)}")
        twice = {axis for axis in named if named.count(axis) > 1}
        if twice:
            raise ValueError(f"axis '{min(twice)}' is given twice, among pattern, order and axes")
        counted = {*self.index_axes, *self.page_axes}
        if set(self.shape) - counted:
            raise ValueError(f"shape names '{min(set(self.shape) - counted)}', which is not in order or axes")
        if set(self.index_axes) - set(self.shape):
            raise ValueError("order needs the sizes of its axes, e.g. shape = { sy = 9, sx = 9 }")
        for axis, chosen in self.select.items():
            if axis not in fields or axis == "i":
                raise ValueError(f"select names '{axis}', which is no field of the pattern")
            if len(chosen) not in (2, 3) or chosen[1] < chosen[0] or (len(chosen) == 3 and chosen[2] < 1):
                raise ValueError(f"select of {axis} is [first, last] or [first, last, step] with first <= last")
        return self


class Camera(_Section):
    """Pinhole camera, the same at every grid position."""

    focal_length_px: _Positive | None = None
    focal_length_mm: _Positive | None = None
    pixel_pitch_mm: _Positive | None = None
    principal_point_px: tuple[_Finite, _Finite] | None = None
    calibration: StrictStr | None = None

    @property
    def calibration_pattern(self) -> Pattern | None:
        """The calibration file's name, with a field for each axis of cameras that it is given for."""
        return None if self.calibration is None else Pattern.parse(self.calibration)

    @field_validator("calibration")
    @classmethod
    def _one_file_per_camera(cls, value: str | None) -> str | None:
        return _of_cameras(value)

    @model_validator(mode="after")
    def _one_focal_length(self) -> Self:
        metric = (self.focal_length_mm is not None, self.pixel_pitch_mm is not None)
        twice = self.focal_length_px is not None and any(metric)
        missing = self.focal_length_px is None and not any(metric) and self.calibration is None
        if twice or missing or metric[0] != metric[1]:
            raise ValueError("give focal_length_px, or focal_length_mm and pixel_pitch_mm, or a calibration")
        return self

    @property
    def f_px(self) -> float | None:
        """Focal length in pixel; None where the calibration states it."""
        if self.focal_length_mm is not None and self.pixel_pitch_mm is not None:
            return self.focal_length_mm / self.pixel_pitch_mm
        return self.focal_length_px


class Grid(_Section):
    """Camera grid; one number each for a 1D grid, ``[x, y]`` else."""

    baseline_mm: _PerAxis
    disparity_offset_px: _PerAxis = (0.0, 0.0)
    positions_mm: tuple[tuple[_Finite, _Finite], ...] | None = None


class Time(_Section):
    """Sampling in time."""

    interval_s: _Positive | None = None
    stamps_s: tuple[_Finite, ...] | None = None
    stamps: StrictStr | None = None

    @model_validator(mode="after")
    def _one_list(self) -> Self:
        if self.stamps_s is not None and self.stamps is not None:
            raise ValueError("give either stamps_s or the file stamps")
        return self


class Description(_Section):
    """A whole ``capture.toml``."""

    images: Images
    camera: Camera | None = None
    grid: Grid | None = None
    time: Time | None = None


def read_description(path: Path) -> Description:
    """Read and check a ``capture.toml``.

    Raises InputError if it cannot be opened, ConfigError (file, key, value, way out) if its content is not valid.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start}): save it as UTF-8") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): give a {FILE_NAME} or its folder") from error
    try:
        return Description.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    except ValidationError as error:
        raise ConfigError(f"{path}: {_one_line(error)}") from error


def read_stamps(path: Path) -> tuple[float, ...]:
    """The numbers of a file with one on each line; InputError, naming the line, where there is something else."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}): give a text file with one time in s on each line"
        ) from error
    found = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            found.append(float(line))
        except ValueError:
            raise InputError(f"{path}: line {number} is {line.strip()!r}: give one time in s on each line") from None
    return tuple(found)


def write_description(path: str | Path, description: Description) -> None:
    """Write ``description`` as a ``capture.toml``: the keys that were set, in the order of the model."""
    lines: list[str] = []
    for section, values in description.model_dump(exclude_unset=True, exclude_none=True).items():
        lines.append(f"[{section}]")
        lines += [f"{key} = {_toml(value)}" for key, value in values.items()]
        lines.append("")
    Path(path).write_text("\n".join(lines), encoding="utf-8")


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)


def _one_line(error: ValidationError) -> str:
    """First error as '[section] key = value: what is wrong', and how many more there are."""
    errors = error.errors(include_url=False)
    first = errors[0]
    keys = [str(part) for part in first["loc"]]
    section, key = keys[0], ".".join(keys[1:])
    place = f"[{section}] {key}".rstrip()
    message = re.sub(r"^Value error, ", "", first["msg"])
    if first["type"] == "extra_forbidden":
        message = f"unknown key; {_known_keys(section if key else None)}"
    elif first["type"] == "missing":
        message = "missing: add it"
    elif key and not isinstance(first["input"], dict):
        place += f" = {first['input']!r}"
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return f"{place}: {message}{more}"


def _known_keys(section: str | None) -> str:
    models: dict[str | None, type[_Section]] = {
        None: Description,
        "images": Images,
        "camera": Camera,
        "grid": Grid,
        "time": Time,
    }
    return "known are " + ", ".join(models[section].model_fields)
