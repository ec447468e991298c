"""By how many whole pixels images are shifted towards the reference, over camera steps and over time."""

from __future__ import annotations

from typing import NamedTuple


class Aim(NamedTuple):
    """An image ``(kx, ky)`` camera steps and n frames from the reference is read at ``x + shift k + motion n``.

    ``shift`` (x, y) px per camera step: the preshift nu0; ``motion`` (x, y) px per frame.
    """

    shift: tuple[int, int]
    motion: tuple[int, int] = (0, 0)

    def offset(self, frames: int, steps: tuple[int, int] = (0, 0)) -> tuple[int, int]:
        """Pixels (x, y) of an image so many frames and camera steps (x, y) from the reference."""
        x, y = (s * k + m * frames for s, k, m in zip(self.shift, steps, self.motion, strict=True))
        return x, y
