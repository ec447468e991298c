"""From a description to a complete table: which page of which file is the image of (t, sy, sx).

Everything is decided from names and headers. What is missing, doubled or unlike the rest is an InputError that names
the files; nothing is filled in.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.channels import ImageInfo, sample_weights
from leafflow_ti.capture.description import Images
from leafflow_ti.capture.files import FileState, Reach
from leafflow_ti.capture.images import probe
from leafflow_ti.capture.pattern import AXES, Pattern
from leafflow_ti.errors import InputError

_SHOWN = 4  # file names in one error line


@dataclass(frozen=True)
class Layout:
    """Complete table of a capture's images."""

    paths: tuple[Path, ...]
    states: tuple[FileState, ...]  # of the paths, when they were found
    file: npt.NDArray[np.int64]  # [t, sy, sx], index into paths
    page: npt.NDArray[np.int64]  # [t, sy, sx]
    values: dict[str, tuple[int, ...]]  # the numbers of the file names along t, sy, sx; (0,) for an axis not named
    found: dict[str, tuple[int, ...]]  # the same without select: all that the pattern finds
    info: ImageInfo


def find_layout(images: Images, reach: Reach, gaps: bool = False, known: Layout | None = None) -> Layout:
    """Find and check all images of a description, in its folder or where ``reach`` allows; headers only.

    ``gaps``: whether numbers of frames may be left out, as where each frame has a time of its own. ``known``: an
    earlier state of it; headers of files that are as they were then are not read again.
    """
    pattern, root = images.file_pattern, reach.root
    everything = pattern.discover(reach)
    found = [(fields, path) for fields, path in everything if selected(fields, images.select)]
    if not found:
        raise InputError(f"no file fits {root / pattern.text}: check the pattern, its padding ({{t:03d}}), and select")
    first_index = min((fields["i"] for fields, _ in found if "i" in fields), default=0)
    files = _by_value(found, images, first_index)
    ranges = _axis_values(files, pattern, images, gaps)
    _check_complete(files, ranges, lambda key: str(root / _file_name(pattern, key, images, first_index)))
    values = {axis: tuple(found) for axis, found in ranges.items()}
    paths = tuple(files[key] for key in itertools.product(*(values[axis] for axis in AXES)))
    states = tuple(FileState.of(reach.file(path)) for path in paths)
    before = dict(zip(known.paths, known.states, strict=True)) if known else {}
    new = [path for path, state in zip(paths, states, strict=True) if before.get(path) != state]
    info = _common_info(new, images, known.info if known else None)
    file = np.arange(len(paths)).reshape([len(values[axis]) for axis in AXES])
    page = np.zeros_like(file)
    sizes = _page_sizes(paths[0], info, images)
    if sizes:
        # Outer product with the pages, in the order of the file, then back to t, sy, sx.
        count = math.prod(sizes.values())
        pages = np.arange(count).reshape([sizes.get(axis, 1) for axis in images.page_axes])
        pages = pages.transpose(np.argsort([AXES.index(axis) for axis in images.page_axes]))
        pages = pages.reshape([sizes.get(axis, 1) for axis in AXES])
        file, page = (np.ascontiguousarray(table) for table in np.broadcast_arrays(file, page + pages))
        values |= {axis: tuple(range(size)) for axis, size in sizes.items()}
    named = {axis: sorted({fields[axis] for fields, _ in everything}) for axis in images.select}
    found_values = values | {axis: tuple(n) for axis, n in named.items()}
    return Layout(paths, states, file, page, values, found_values, info)


_Key = tuple[int, ...]  # values along AXES


def _by_value(found: Sequence[tuple[dict[str, int], Path]], images: Images, first_index: int) -> dict[_Key, Path]:
    """Files by their values along t, sy, sx; a running index is unfolded here."""
    files: dict[_Key, Path] = {}
    for fields, path in found:
        at = dict(fields)
        if images.index_axes:
            at |= _unfold(at.pop("i") - first_index, images, path)
        key = tuple(at.get(axis, 0) for axis in AXES)
        if key in files:
            raise InputError(f"two files for one image: {files[key]} and {path}: remove one, or narrow the pattern")
        files[key] = path
    return files


def selected(fields: Mapping[str, int], select: Mapping[str, tuple[int, ...]]) -> bool:
    """Whether a file with these numbers is one that a description selects."""
    return all(fields[axis] in _select_range(chosen) for axis, chosen in select.items())


def _select_range(chosen: tuple[int, ...]) -> range:
    return range(chosen[0], chosen[1] + 1, *chosen[2:])


def _unfold(index: int, images: Images, path: Path) -> dict[str, int]:
    total = math.prod(images.shape[axis] for axis in images.index_axes)
    if index >= total:
        raise InputError(f"{path}: image {index + 1} of a shape with {total}: correct shape, or the pattern")
    at = {}
    for axis in reversed(images.index_axes):  # whole numbers of any size, unlike those of NumPy
        index, at[axis] = divmod(index, images.shape[axis])
    return at


def _axis_values(files: Iterable[_Key], pattern: Pattern, images: Images, gaps: bool) -> dict[str, Sequence[int]]:
    """Values that each axis should have: evenly spaced between the first and the last found, or as selected; with
    ``gaps`` frames are those that are found. Ranges: two files with far numbers stand for more than memory holds."""
    result: dict[str, Sequence[int]] = {}
    for k, axis in enumerate(AXES):
        found = sorted({key[k] for key in files})
        if axis in images.index_axes:
            result[axis] = range(images.shape[axis])
        elif axis == "t" and gaps:
            result[axis] = tuple(found)
        elif axis in images.select:
            result[axis] = _select_range(images.select[axis])
        elif axis in pattern.fields and len(found) > 1:
            step = math.gcd(*(b - a for a, b in itertools.pairwise(found)))
            result[axis] = range(found[0], found[-1] + 1, step)
        else:
            result[axis] = tuple(found)
    return result


def _check_complete(
    files: Mapping[_Key, Path], values: Mapping[str, Sequence[int]], name: Callable[[_Key], str]
) -> None:
    """InputError, naming the first, where there is not a file for each combination of values."""
    wanted = math.prod(len(values[axis]) for axis in AXES)
    if wanted == len(files):  # none has values that are not wanted
        return
    surplus = [str(path) for path in _surplus(files)]
    if surplus:
        raise InputError(
            f"{len(surplus)} image(s) of frames that most cameras do not have: {_list(surplus)}: remove them, add "
            "those of the other cameras, or use select"
        )
    keys = ((t, sy, sx) for t in values["t"] for sy in values["sy"] for sx in values["sx"])
    missing = itertools.islice((key for key in keys if key not in files), _SHOWN)
    number = wanted - len(files)
    raise InputError(
        f"{number} of {wanted} images are missing: {_list([name(key) for key in missing], number)}: add them, or use "
        "select"
    )


def _surplus(files: Mapping[_Key, Path]) -> list[Path]:
    """Files of frames that fewer than half of the cameras have, where all is complete without these."""
    cameras = {key[1:] for key in files}
    count = Counter(key[0] for key in files)
    few = {t for t, n in count.items() if 2 * n < len(cameras)}
    surplus = [path for key, path in files.items() if key[0] in few]
    return surplus if len(files) - len(surplus) == (len(count) - len(few)) * len(cameras) else []


def _file_name(pattern: Pattern, key: _Key, images: Images, first_index: int) -> str:
    """Name that a missing image should have."""
    fields = dict(zip(AXES, key, strict=True))
    if images.index_axes:
        index = 0
        for axis in images.index_axes:
            index = index * images.shape[axis] + fields[axis]
        fields["i"] = first_index + index
    return pattern.format(fields)


def _common_info(paths: Sequence[Path], images: Images, known: ImageInfo | None) -> ImageInfo:
    """Header of the first file, or the ``known`` one, after checking that all others agree with it."""
    if known is not None and not paths:
        return known
    first = known or probe(paths[0])
    unlike = []
    for path in paths:
        info = probe(path)
        if info.mismatch:
            raise InputError(f"{path}: pages differ ({info.mismatch}): save each kind as a file of its own")
        if _kind(info) != _kind(first):
            unlike.append(f"{path} ({_describe(info)})")
    if unlike:
        raise InputError(
            f"{len(unlike)} of {len(paths)} files are not like {paths[0]} ({_describe(first)}): {_list(unlike)}"
        )
    sample_weights(paths[0], first, images.channel)
    if images.bit_depth is not None and (first.dtype.kind == "f" or images.bit_depth > 8 * first.dtype.itemsize):
        raise InputError(f"{paths[0]}: bit_depth = {images.bit_depth} does not fit {_describe(first)}: correct it")
    return first


def _kind(info: ImageInfo) -> tuple[Any, ...]:
    return info.height, info.width, info.dtype, info.bits, info.samples, info.colour, info.page_shape


def _describe(info: ImageInfo) -> str:
    pages = f", {info.pages} pages" if info.pages > 1 else ""
    return f"{info.height} x {info.width}, {info.colour}, {info.bits} bit {info.dtype}{pages}"


def _page_sizes(path: Path, info: ImageInfo, images: Images) -> dict[str, int]:
    """Sizes of the page axes, from the description, else from the file."""
    axes = images.page_axes
    if not axes:
        if info.pages > 1:
            raise InputError(f'{path}: {info.pages} pages: name their axes, e.g. axes = "t y x"')
        return {}
    if set(axes) <= set(images.shape):
        sizes = tuple(images.shape[axis] for axis in axes)
    elif len(axes) == 1:
        sizes = (info.pages,)
    elif len(info.page_shape) == len(axes):
        sizes = info.page_shape
    else:
        raise InputError(
            f"{path}: {info.pages} pages for the axes {' '.join(axes)}: "
            f"state their sizes, e.g. shape = {{ {', '.join(f'{axis} = 3' for axis in axes)} }}"
        )
    stated = {axis: size for axis, size in zip(axes, sizes, strict=True) if images.shape.get(axis, size) != size}
    if math.prod(sizes) != info.pages or stated:
        wanted = " x ".join(f"{axis} {images.shape.get(axis, size)}" for axis, size in zip(axes, sizes, strict=True))
        raise InputError(f"{path}: {info.pages} pages, the description asks for {wanted}: correct shape or axes")
    return dict(zip(axes, sizes, strict=True))


def _list(names: Sequence[str], total: int | None = None) -> str:
    """The first names; ``total``: how many there are, where ``names`` are the first of them."""
    total = len(names) if total is None else total
    rest = f" and {total - _SHOWN} more" if total > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + rest
