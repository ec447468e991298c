"""Calibration files of OpenCV: FileStorage as YAML, XML or JSON, or a ``camera_info`` YAML, for one camera each.

    camera_matrix               3x3: fx, fy, cx, cy [px]
    distortion_coefficients     k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]: 4, 5, 8, 12 or 14; or none
    image_width, image_height   of the images it was made from, checked where they are there
    rectification_matrix        3x3: turns the camera's rays into those of the rectified one [identity]
    projection_matrix           3x3 or 3x4: the rectified camera; square pixels, the same for all cameras of a grid

Matrices may be OpenCV's (``rows``, ``cols``, ``data``) or nested lists. Where a camera stands is said by ``[grid]``:
the last column of a projection matrix is not used.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.files import read_text
from leafflow_ti.errors import ConfigError, InputError

Array = npt.NDArray[np.float64]

COEFFICIENTS = 14
LARGEST_FILE = 2**18
"""Bytes of a calibration, with room for the points that it was made from."""
LARGEST_NUMBER = 1e9
"""Of any entry: those of cameras are far below, and its square and cube can be computed with."""
WAY_OUT = "check [camera] calibration"
_SHOWN = 200  # characters of what another program says
_COUNTS = (0, 4, 5, 8, 12, 14)
_TURN_TOLERANCE = 1e-4
"""By how much ``R Rᵀ`` may differ from 1: files are written with few digits."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """One file: ``matrix`` [3, 3], ``distortion`` [14] in OpenCV's order, ``rotation`` [3, 3], ``projection`` (f, cx,
    cy) [px] or None, ``size`` (width, height) or None."""

    path: Path
    matrix: Array
    distortion: Array
    rotation: Array
    projection: tuple[float, float, float] | None
    size: tuple[int, int] | None

    @property
    def pinhole(self) -> tuple[float, float, float]:
        """Focal length and principal point of the rectified camera; without one in the file, square pixels of the mean
        focal length."""
        fx, fy, cx, cy = self.matrix[0, 0], self.matrix[1, 1], self.matrix[0, 2], self.matrix[1, 2]
        return self.projection or (float(fx + fy) / 2, float(cx), float(cy))


def read_calibration(path: Path) -> Calibration:
    """Read one calibration file.

    Raises InputError if it cannot be read or is damaged, ConfigError, naming file and key, for what is missing, out of
    range or not supported.
    """
    try:
        values = _parsed(path, read_text(path, LARGEST_FILE, WAY_OUT))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start}): save it as UTF-8") from error
    _check_lens_model(path, values)
    if "camera_matrix" not in values:
        known = ", ".join(map(str, itertools.islice(values, 20)))[:_SHOWN] or "nothing"
        raise ConfigError(f"{path}: camera_matrix is missing, found {known}: give a calibration of one camera")
    matrix = _matrix(path, values, "camera_matrix", ((3, 3),))
    _check_pinhole(path, "camera_matrix", matrix)
    rotation = np.eye(3)
    if "rectification_matrix" in values:
        rotation = _matrix(path, values, "rectification_matrix", ((3, 3),))
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _TURN_TOLERANCE or np.linalg.det(rotation) < 0:
            raise ConfigError(f"{path}: rectification_matrix is no rotation: its rows must be orthogonal unit vectors")
    projection = None
    if "projection_matrix" in values:
        found = _matrix(path, values, "projection_matrix", ((3, 3), (3, 4)))
        _check_pinhole(path, "projection_matrix", found)
        if not np.isclose(found[0, 0], found[1, 1], rtol=1e-9, atol=0.0):
            raise ConfigError(
                f"{path}: projection_matrix has focal lengths {found[0, 0]:g} and {found[1, 1]:g} px: rectified pixels "
                "must be square, give the same for both"
            )
        projection = (float(found[0, 0]), float(found[0, 2]), float(found[1, 2]))
    return Calibration(path, matrix, _distortion(path, values), rotation, projection, _size(path, values))


def _parsed(path: Path, text: str) -> Mapping[str, Any]:
    """Keys and values, whatever the notation; matrices of XML in the form of the others."""
    start = text.lstrip()
    try:
        if start.startswith("<"):
            values = _from_xml(path, start)
        elif start.startswith("{"):
            values = json.loads(start)
        else:
            values = _from_yaml(start)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        kind = " ".join(str(error).split())[:_SHOWN]
        raise InputError(f"{path}: not a calibration in YAML, XML or JSON ({kind}): write it anew") from error
    if not isinstance(values, Mapping):
        raise InputError(f"{path}: holds no keys such as camera_matrix: give an OpenCV calibration file")
    return values


def _from_yaml(text: str) -> Any:
    import yaml

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """Plain values, and OpenCV's matrices as what they are written as: mappings."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            """As usual, but for aliases: few lines of these stand for more than memory holds."""
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("aliases (*name) are not used in calibrations")
            return super().compose_node(parent, index)

    Loader.add_constructor(
        "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
    )
    if text.startswith("%YAML"):  # OpenCV writes "%YAML:1.0", which is no YAML
        text = text.partition("\n")[2]
    try:
        return yaml.load(text, Loader)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error


def _from_xml(path: Path, text: str) -> dict[str, Any]:
    if "<!" in text.replace("<!--", ""):
        raise InputError(f"{path}: declares a document type or entities, which calibrations do not need: remove them")

    def value(node: ElementTree.Element) -> Any:
        if node.find("data") is None:
            return (node.text or "").strip().strip('"')
        return {child.tag: (child.text or "").split() if child.tag == "data" else child.text for child in node}

    return {node.tag: value(node) for node in ElementTree.fromstring(text)}


def _check_lens_model(path: Path, values: Mapping[str, Any]) -> None:
    model = str(values.get("distortion_model", "plumb_bob"))
    fisheye = str(values.get("fisheye_model", "0")).strip().lower() not in ("0", "false", "none", "")
    if fisheye or model not in ("plumb_bob", "rational_polynomial"):
        name = "fisheye" if fisheye else model
        raise ConfigError(
            f"{path}: lens model '{name}' is not supported: calibrate with the pinhole model (plumb_bob or "
            "rational_polynomial)"
        )


def _numbers(path: Path, values: Mapping[str, Any], key: str) -> tuple[Array, tuple[int, ...]]:
    """The numbers of a matrix, row by row, and its stated shape."""
    found = values[key]
    try:
        if isinstance(found, Mapping):
            numbers = np.array([float(v) for v in found["data"]])
            shape = (int(found["rows"]), int(found["cols"]))
        else:
            rows = found if isinstance(found, Sequence) and not isinstance(found, str) else [found]
            numbers = np.array(rows, dtype=np.float64)
            shape, numbers = numbers.shape, numbers.reshape(-1)
        if numbers.size != np.prod(shape):
            raise ValueError(f"{numbers.size} numbers for {' x '.join(map(str, shape))}")
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        kind = " ".join(str(error).split())[:_SHOWN]
        raise ConfigError(f"{path}: {key} is no matrix with rows, cols and data ({kind}): write it anew") from error
    if not np.isfinite(numbers).all():
        raise ConfigError(f"{path}: {key} holds values that are not finite: calibrate anew")
    if np.abs(numbers).max(initial=0) > LARGEST_NUMBER:
        raise ConfigError(f"{path}: {key} holds values beyond {LARGEST_NUMBER:g}: calibrate anew")
    return numbers, shape


def _matrix(path: Path, values: Mapping[str, Any], key: str, shapes: tuple[tuple[int, int], ...]) -> Array:
    numbers, shape = _numbers(path, values, key)
    if shape not in shapes and numbers.size not in {rows * cols for rows, cols in shapes if len(shape) == 1}:
        wanted = " or ".join(f"{rows} x {cols}" for rows, cols in shapes)
        raise ConfigError(f"{path}: {key} is {' x '.join(map(str, shape))}, it must be {wanted}")
    return numbers.reshape(3, -1)


def _check_pinhole(path: Path, key: str, matrix: Array) -> None:
    """Focal lengths above 0, no skew, the last row 0 0 1: what the pinhole model of OpenCV has."""
    if not (matrix[0, 0] > 1 / LARGEST_NUMBER and matrix[1, 1] > 1 / LARGEST_NUMBER):
        raise ConfigError(
            f"{path}: {key} is singular or mirrored, focal lengths {matrix[0, 0]:g}, {matrix[1, 1]:g} px: both must be "
            "positive"
        )
    if matrix[0, 1] != 0 or matrix[1, 0] != 0 or not np.array_equal(matrix[2, :3], [0, 0, 1]):
        raise ConfigError(
            f"{path}: {key} is not of the form [fx 0 cx; 0 fy cy; 0 0 1]: skewed pixels are not supported"
        )


def _distortion(path: Path, values: Mapping[str, Any]) -> Array:
    key = "distortion_coefficients"
    numbers = np.empty(0) if values.get(key) is None else _numbers(path, values, key)[0]
    if numbers.size not in _COUNTS:
        allowed = ", ".join(map(str, _COUNTS[1:-1]))
        raise ConfigError(
            f"{path}: {key} are {numbers.size}, OpenCV's are {allowed} or {_COUNTS[-1]}: write all of them"
        )
    return np.concatenate([numbers, np.zeros(COEFFICIENTS - numbers.size)])


def _size(path: Path, values: Mapping[str, Any]) -> tuple[int, int] | None:
    if "image_width" not in values or "image_height" not in values:
        return None
    try:
        return int(values["image_width"]), int(values["image_height"])
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{path}: image_width or image_height is no whole number: correct it") from error
