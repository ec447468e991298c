"""What a kernel is compiled for: structure only, never a value.

A *group* is ``lanes`` neighbouring pixels that are worked on together. On the CPU the lanes are one vector (or, in the
kernels of ``planes``, the innermost loop), and a few tasks share the groups; on a GPU a group is one pixel and every
group a thread.
"""

from dataclasses import dataclass

from leafflow_ti.kernels.engine import lane_type, ti

TASK_GRAIN = 512
"""Iterations that the engine's CPU thread pool hands out at once; a task occupies exactly one such piece."""
EXTRA_PLANES = 4
"""Behind a tensor's entries: window mass, energies of the gradient, of it smoothed once more, of the image."""


@dataclass(frozen=True)
class KernelSpec:
    """``storage``: type of images and moments; ``algebra``: type of the small dense matrices; "f32" or "f64".

    ``cut``: windows may be cut by a mask or a border; who has none does not wait for what that takes.
    """

    storage: str = "f32"
    algebra: str = "f64"
    lanes: int = 32
    gpu: bool = False
    cut: bool = False

    @property
    def real(self):
        """Engine type of images and moments."""
        return getattr(ti, self.storage)

    @property
    def precise(self):
        """Engine type of the small dense matrices."""
        return getattr(ti, self.algebra)

    @property
    def element(self):
        """Engine type of one element of the workspace: its value in every lane."""
        return lane_type(self.precise, self.lanes)
