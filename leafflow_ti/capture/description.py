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
    AfterValidator,
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
from leafflow_ti.capture.files import read_text
from leafflow_ti.capture.pattern import AXES, MOST_DIGITS, Pattern, path_text
from leafflow_ti.errors import ConfigError, InputError

FILE_NAME = "capture.toml"
LARGEST_NUMBER = 1e9
"""Of lengths [mm, px] and counts: beyond any camera, and its square and cube can be computed with."""
LATEST = 1e12
"""Of times [s]."""
LARGEST_FILE = 2**20
"""Bytes of a description: some 80,000 stamps; longer ones take parsers of TOML many seconds."""
LARGEST_STAMPS = 64 * 2**20
"""Bytes of a file of stamps."""
STAMPS_WAY_OUT = "give a text file with one time in s on each line"
_DEEPEST_KEY = 32
_DEEP_KEY = re.compile(
    r"""(?<![\w.-])(?:(?:"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+'|[\w-]++)[ \t]*+\.[ \t]*+)"""
    rf"{{{_DEEPEST_KEY}}}"
)
"""A dotted key of more parts than any has: the time to parse one grows with their square."""
_SHOWN = 80  # characters of a wrong value in a message


def _as_list(value: object) -> object:
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else value


def _not_tiny(value: float) -> float:
    if value < 1 / LARGEST_NUMBER:
        raise ValueError(f"input should be at least {1 / LARGEST_NUMBER:g}")
    return value


_Finite = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
_Positive = Annotated[
    float, Field(strict=True, allow_inf_nan=False, gt=0, le=LARGEST_NUMBER), AfterValidator(_not_tiny)
]
_Stamp = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-LATEST, le=LATEST)]
_Index = Annotated[StrictInt, Field(gt=-(10**MOST_DIGITS), lt=10**MOST_DIGITS)]
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
    shape: dict[StrictStr, Annotated[StrictInt, Field(ge=1, le=int(LARGEST_NUMBER))]] = {}
    select: dict[StrictStr, tuple[_Index, ...]] = {}
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
    stamps_s: tuple[_Stamp, ...] | None = None
    stamps: Annotated[StrictStr, AfterValidator(path_text)] | None = None

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
        text = read_text(path, LARGEST_FILE, f"give a {FILE_NAME} or its folder")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start}): save it as UTF-8") from error
    try:
        return Description.model_validate(_parsed(text))
    except ValidationError as error:
        raise ConfigError(f"{path}: {_one_line(error)}") from error
    except (ValueError, RecursionError) as error:  # not of TOML, numbers of thousands of digits, nested too deeply
        raise ConfigError(f"{path}: not valid TOML: {_short(str(error), 2 * _SHOWN)}") from error


def _parsed(text: str) -> dict[str, Any]:
    deep = _DEEP_KEY.search(text)
    if deep is not None:
        line = text.count("\n", 0, deep.start()) + 1
        raise ValueError(f"a key of {_DEEPEST_KEY} parts and more (at line {line}): write [section] and key")
    return tomllib.loads(text)


def read_stamps(path: Path) -> tuple[float, ...]:
    """The numbers of a file with one on each line; InputError, naming the line, where there is something else."""
    try:
        lines = read_text(path, LARGEST_STAMPS, STAMPS_WAY_OUT).splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start}): {STAMPS_WAY_OUT}") from error
    found = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            found.append(float(line))
        except ValueError:
            raise InputError(f"{path}: line {number} is {_shown(line.strip())}: {STAMPS_WAY_OUT}") from None
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
    keys = [_short(str(part), _SHOWN) for part in first["loc"]]
    section, key = keys[0], ".".join(keys[1:])
    place = f"[{section}] {key}".rstrip()
    message = re.sub(r"^Value error, ", "", first["msg"])
    if first["type"] == "extra_forbidden":
        message = f"unknown key; {_known_keys(section if key else None)}"
    elif first["type"] == "missing":
        message = "missing: add it"
    elif key and not isinstance(first["input"], dict):
        place += f" = {_shown(first['input'])}"
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return f"{place}: {message}{more}"


def _shown(value: object) -> str:
    """A wrong value in few characters; one that Python itself does not write by its type."""
    try:
        return _short(repr(value), _SHOWN)
    except (ValueError, RecursionError):
        return f"({type(value).__name__} too long to show)"


def _short(text: str, most: int) -> str:
    text = " ".join(text.split())
    return text if len(text) <= most else f"{text[: most - 4]} ..."


def _known_keys(section: str | None) -> str:
    models: dict[str | None, type[_Section]] = {
        None: Description,
        "images": Images,
        "camera": Camera,
        "grid": Grid,
        "time": Time,
    }
    return "known are " + ", ".join(models[section].model_fields)
