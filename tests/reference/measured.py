"""The textured plane seen by cameras at any places and at any times."""

from dataclasses import dataclass

import numpy as np

from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.synthetic.plane import PlaneScene


@dataclass(frozen=True, kw_only=True)
class MeasuredScene(PlaneScene):
    """``places`` [rows, columns, (x, y)] of the cameras from the reference [mm], ``times`` [frames]; () if even."""

    places: tuple = ()
    times: tuple = ()

    def camera_position(self, row, col):
        """See ``RigidScene``."""
        if not self.places:
            return super().camera_position(row, col)
        return np.array([*self.places[row][col], 0.0])

    def time(self, frame):
        """See ``RigidScene``."""
        return float(self.times[frame]) if self.times else super().time(frame)

    @property
    def geometry(self):
        """Nominal geometry."""
        x, y = self.baseline_mm
        return Geometry(self.f_px, self.principal, (x if self.n_cols > 1 else 0.0, y if self.n_rows > 1 else 0.0))

    def capture(self, images, positions=True, stamps=True):
        """The capture, with the positions and stamps that the scene has or without; 10 s between frames."""
        return capture_from_array(
            images, self.geometry, 10.0,
            positions_mm=np.array(self.places) if self.places and positions else None,
            stamps_s=[10.0 * t for t in self.times] if self.times and stamps else None,
        )  # fmt: skip


def off_by(rows, cols, baseline, micrometres, seed=0):
    """Places of a grid whose cameras are off by half of ``micrometres`` to all of it along each axis, at random."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.arange(rows) - rows // 2, np.arange(cols) - cols // 2, indexing="ij")
    off = rng.choice([-1e-3, 1e-3], (rows, cols, 2)) * micrometres * rng.uniform(0.5, 1, (rows, cols, 2))
    places = baseline * np.stack([x, y], axis=-1) + off
    places -= places[rows // 2, cols // 2]
    return tuple(tuple(map(tuple, row)) for row in places.tolist())
