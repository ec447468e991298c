"""Range flow's input: from camera images, or given range maps, to the stack of images of one frame and its factors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.range_flow import factors, images, window_radius
from leafflow_ti.range_plan import RangePlan
from leafflow_ti.runtime import Device
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.estimate import EstimateStage, View
from leafflow_ti.stages.gradients import GradientStage
from leafflow_ti.stages.tensor import Band, TensorStage
from leafflow_ti.status import HAS_VALUE, Status

Array = NDArray[Any]


@dataclass
class Sample:
    """One frame of one band as the tensor stages take it.

    ``block`` [sy, sx, in_rows, in_cols]: images; ``valid``: pixels that count; ``status``: why a pixel has none, OK
    else; ``factors`` of derived channels; ``maps``: results that the input itself holds. Planes are [in_rows, in_cols].
    """

    block: Array
    valid: NDArray[np.bool_]
    status: NDArray[np.uint8]
    factors: Array | None = None
    maps: dict[str, Array] = field(default_factory=dict)


def eroded(valid: NDArray[np.bool_], ry: int, rx: int) -> NDArray[np.bool_]:
    """Where all pixels within (ry, rx) are valid; without the outermost ry rows and rx columns."""
    rows, cols = valid.shape[0] - 2 * ry, valid.shape[1] - 2 * rx
    inside = np.ones((rows, cols), bool)
    for dy, dx in product(range(2 * ry + 1), range(2 * rx + 1)):
        inside &= valid[dy : dy + rows, dx : dx + cols]
    return inside


class RangeEngine:
    """Makes the samples of range flow for bands of one size; ``outer`` is the block of images that it needs."""

    def __init__(self, device: Device, plan: RangePlan, sampling: Sampling, view: View, band: Band):
        self.plan, self.band, self._radius = plan, band, window_radius(sampling)
        rows, cols = band.in_rows, band.in_cols
        self.gradients = GradientStage(device, sampling, rows, cols) if plan.gradients else None
        radius = self.gradients.radius if self.gradients else 0
        self._tensor: TensorStage | None = None
        self._estimate: EstimateStage | None = None
        self.outer = Band(rows, cols, 1, radius, radius)
        if plan.depth is not None and plan.layout is not None:
            self.outer = Band.of(plan.depth.sampling, rows, cols, 1)
            self._tensor = TensorStage(
                device, plan.depth.columns, plan.layout, plan.depth.sampling, self.outer,
                mask=plan.depth.mask_moments(plan.layout),
            )  # fmt: skip
            own = replace(view, step=1, rows=rows, cols=cols, pitch=self._tensor.out_pitch)
            self._estimate = EstimateStage(device, plan.depth, plan.layout, own)

    def move(self, view: View, corner: tuple[int, int]) -> tuple[int, int]:
        """Go to the band whose block begins at pixel (y, x) ``corner``; the corner of ``outer``'s block.

        ``view``: the camera, as range flow itself sees it.
        """
        if self._tensor is not None and self._estimate is not None:
            self._tensor.reset()
            own = self._estimate.view
            self._estimate.set_view(
                replace(view, x=corner[1], y=corner[0], step=1, rows=own.rows, cols=own.cols, pitch=own.pitch)
            )
        self._corner = corner
        return corner[0] - self.outer.halo_y, corner[1] - self.outer.halo_x

    def sample(self, t: int, block: Array, seen: NDArray[np.bool_], finite: NDArray[np.bool_]) -> Sample:
        """The sample of frame ``t`` from the images [sy, sx, rows, cols] of ``outer``.

        ``seen``: where every image has a value that counts; ``finite``: where the values are finite.
        """
        rows, cols = self.band.in_rows, self.band.in_cols
        top, left = self.outer.halo_y, self.outer.halo_x
        inner = (slice(top, top + rows), slice(left, left + cols))
        status = np.where(finite[inner], np.uint8(Status.OK), np.uint8(Status.NOT_FINITE))
        maps, found = self._range(t, block, seen)
        depth, noise = (maps[name].astype(np.float64) for name in ("depth", "depth_std"))
        missing = ~np.isin(found, HAS_VALUE) | ~np.isfinite(depth) | ~np.isfinite(noise) | (depth <= 0)
        depth[missing] = np.nan
        status = np.where(
            missing & (status == Status.OK), np.where(found == Status.OK, Status.NOT_FINITE, found), status
        )
        reference = block[block.shape[0] // 2, block.shape[1] // 2]
        valid = seen[inner] & ~missing
        stack = [reference[inner], np.where(missing, 0.0, depth - self.plan.working_mm)]
        if self.gradients:
            r = self.gradients.radius
            around = (slice(top - r, top + rows + r), slice(left - r, left + cols + r))
            stack += list(self.gradients(reference[around]))
            valid &= eroded(seen[around], r, r)
        assert len(stack) == len(images(self.plan.constraint))
        planes = factors(
            depth, noise * self.plan.samples**0.5, self.plan.working_mm, self._radius, self.plan.image_noise,
            self.plan.beta,
        )  # fmt: skip
        return Sample(np.array(stack)[None], valid, status.astype(np.uint8), planes, maps)

    def _range(self, t: int, block: Array, seen: NDArray[np.bool_]) -> tuple[dict[str, Array], Array]:
        """Maps of the range and its status."""
        if self.plan.given is not None:
            depth, noise = self.plan.given.window(t, *self._corner, self.outer.rows, self.outer.cols)
            return {"depth": depth, "depth_std": noise}, np.full(depth.shape, Status.OK, np.uint8)
        assert self._tensor is not None
        assert self._estimate is not None
        from leafflow_ti.kernels.maps import Output

        planes = self._estimate(self._tensor.push(block, seen))
        maps = {}
        for name in self.plan.quantities:
            maps[name] = np.array(planes[Output[name.upper()]])
            maps[f"{name}_std"] = np.array(planes[Output.STD + Output[name.upper()]])
        return maps, planes[Output.STATUS].astype(np.uint8)
