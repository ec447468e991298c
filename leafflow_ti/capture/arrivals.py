"""A capture that is still being taken: which frames are whole by now, and what the next one lacks.

A file counts when it is a regular one, has not changed for a while, and has a header that can be read. A frame counts
when all of its cameras' files do, and all frames before it.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from leafflow_ti.capture.cache import ImageCache
from leafflow_ti.capture.description import read_description
from leafflow_ti.capture.files import FileState, Reach
from leafflow_ti.capture.images import probe
from leafflow_ti.capture.layout import Layout, selected
from leafflow_ti.capture.opening import DEFAULT_CACHE_BYTES, description_path, open_described
from leafflow_ti.capture.sources import FileCapture
from leafflow_ti.errors import ConfigError, InputError

SETTLE_S = 2.0
"""Seconds for which a file must not have changed."""
LONG_SETTLED = 10.0
"""A file last written so many times ``SETTLE_S`` ago by its own clock needs no watching: that clock may be wrong by as
much as networks allow."""
_SHOWN = 4

_Camera = tuple[int, int]


@dataclass
class Arrivals:
    """Watches the folder of a description; ``complete``: numbers of the frames that are whole, in order.

    ``lacking``: what the next frame lacks, in words, "" where nothing of it is there. ``changed_s``: when anything
    arrived or grew last, by ``time.monotonic``. Raises what reading the description raises, and ConfigError for
    captures whose end cannot be told: stacks, and those with stamps.
    """

    path: Path
    outside: bool = False
    settle_s: float = SETTLE_S
    complete: list[int] = field(default_factory=list, init=False)
    lacking: str = field(default="", init=False)
    changed_s: float = field(default_factory=time.monotonic, init=False)

    def __post_init__(self) -> None:
        self.path = description_path(self.path)
        self._description = read_description(self.path)
        self._reach = Reach(self.path.parent, self.outside)
        self._images, time_section = self._description.images, self._description.time
        if "t" not in self._images.file_pattern.fields:
            raise ConfigError(
                f"{self.path}: a capture is followed file by file: name its images by a pattern with {{t}}, or wait "
                "for its end"
            )
        if time_section is not None and (time_section.stamps_s or time_section.stamps):
            raise ConfigError(f"{self.path}: stamps are known when a capture has ended: give interval_s, or wait")
        self._seen: dict[Path, tuple[FileState, float]] = {}
        self._whole: set[Path] = set()
        self._cameras: set[_Camera] = set()
        self._layout: Layout | None = None

    @property
    def interval_s(self) -> float | None:
        """Time between frames that the description states."""
        return None if self._description.time is None else self._description.time.interval_s

    def look(self) -> int:
        """Look once; how many frames are whole. Raises InputError where what arrives cannot belong to one capture."""
        frames = self._found()
        for numbers in frames.values():
            self._cameras |= numbers.keys()
        order = sorted(frames)
        step = math.gcd(*(b - a for a, b in itertools.pairwise(order))) or 1
        if step > 1 and len(order) < 3:  # one between them may be late
            return len(self.complete)
        done = set(self.complete)
        late = [t for t in order if done and t < self.complete[-1] and t not in done]
        if late:
            raise InputError(
                f"{next(iter(frames[late[0]].values()))}: has appeared between frames that are done already: run again "
                "with --overwrite"
            )
        self.lacking = ""
        while True:
            expected = self.complete[-1] + step if self.complete else order[0] if order else None
            if expected is None or order[-1:] < [expected]:
                break
            self.lacking = self._lacks(expected, frames.get(expected, {}))
            if self.lacking:
                break
            self.complete.append(expected)
            self.changed_s = time.monotonic()
        return len(self.complete)

    def capture(self, n_frames: int) -> FileCapture:
        """The first ``n_frames`` that are whole, as a capture; raises what ``open_capture`` raises."""
        numbers = self.complete[:n_frames]
        step = numbers[1] - numbers[0] if n_frames > 1 else 1
        select = {**self._images.select, "t": (numbers[0], numbers[-1], step)}
        images = self._images.model_copy(update={"select": select})
        description = self._description.model_copy(update={"images": images})
        cache = ImageCache(DEFAULT_CACHE_BYTES)
        capture = open_described(self.path, description, self._reach, cache, self._layout)
        self._layout = capture.layout
        return capture

    def _found(self) -> dict[int, dict[_Camera, Path]]:
        """Files by frame and camera."""
        frames: dict[int, dict[_Camera, Path]] = {}
        for fields, path in self._images.file_pattern.discover(self._reach):
            if selected(fields, self._images.select):
                frames.setdefault(fields["t"], {})[fields.get("sy", 0), fields.get("sx", 0)] = path
        return frames

    def _lacks(self, number: int, files: Mapping[_Camera, Path]) -> str:
        """What a frame lacks."""
        unready = [text for path in files.values() if (text := self._unready(path))]
        there = len(files) - len(unready)
        if not unready and len(files) == len(self._cameras):
            return ""
        pattern = self._images.file_pattern
        for camera in sorted(self._cameras - files.keys()):
            name = pattern.format({"t": number, "sy": camera[0], "sx": camera[1]})
            unready.append(f"{name} is not there")
        more = f" and {len(unready) - _SHOWN} more" if len(unready) > _SHOWN else ""
        return f"frame {number}: {there} of {len(self._cameras)} images: {', '.join(unready[:_SHOWN])}{more}"

    def _unready(self, path: Path) -> str:
        """Why a file does not count yet; "" where it does."""
        if path in self._whole:
            return ""
        name = path.relative_to(self.path.parent) if path.is_relative_to(self.path.parent) else path
        try:
            state, now = FileState.of(self._reach.file(path)), time.monotonic()
        except InputError as error:
            return str(error)
        before = self._seen.get(path)
        if before is None or before[0] != state:
            self._seen[path] = state, now
            self.changed_s = now
            if time.time() - state.mtime_ns / 1e9 < LONG_SETTLED * self.settle_s:
                return f"{name} is being written"
        elif now - before[1] < self.settle_s:
            return f"{name} is being written"
        try:
            probe(path)
        except InputError as error:
            return str(error)
        self._whole.add(path)
        del self._seen[path]
        return ""
