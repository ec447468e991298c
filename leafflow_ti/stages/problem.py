"""What is estimated: columns, rows and unknowns; a value, independent of band and device."""

from __future__ import annotations

from dataclasses import dataclass, replace

from leafflow_ti.models import ColumnSet, TensorLayout
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.channels import Request
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.mask_moments import MaskMoments


@dataclass(frozen=True)
class OwnFlows:
    """The flows of single cameras in the motion fit (6.15): their data vector, and where the cameras stand.

    ``steps``: (x, y) steps of each camera from the reference. ``offsets``: of their rows. ``unknowns``: components of
    (N, Ω, A) in the fit; ``growth``: and the rate at which the patch grows in its plane.
    ``reference_rows``: the rows of the reference model take part, too. ``places``: where the cameras really stand, (x,
    y) in steps from the reference; none: at ``steps``.
    """

    columns: ColumnSet
    sampling: Sampling
    steps: tuple[tuple[int, int], ...]
    offsets: tuple[str, ...]
    unknowns: int
    reference_rows: bool
    growth: bool = False
    places: tuple[tuple[float, float], ...] = ()

    @property
    def requests(self) -> tuple[Request, ...]:
        """What the tensor stage is asked for: one tensor of each camera."""
        layout = TensorLayout.of(self.columns)
        return tuple(Request(self.columns, layout, self.sampling, (y, x)) for x, y in self.steps)


@dataclass(frozen=True)
class Problem:
    """What is estimated: columns, geometry terms, motion rows; independent of band and device.

    ``offsets`` and ``use_range`` are what ``models.parse_rows`` returned; ``fitted``: unknowns of the motion fit to the
    reference's rows (0: none), from which a fit with ``own_flows`` starts. ``range_scale``: of range flow, mm per px of
    (U', V') and of W. ``noise``: standard deviation of the images' noise, grey values, as far as it is known;
    ``scale``: of the coordinates in raw units (section 2.3.3); ``penalty`` and ``robust``: of robust estimators, how
    residuals count and which pixels are estimated anew. ``cut``: a mask or a border may cut windows, or pixels may be
    invalid.
    """

    columns: ColumnSet
    sampling: Sampling
    estimator: str = "tls-equilibrated"
    solver: str = "fast"
    weighted: bool = True
    offsets: tuple[str, ...] = ("1",)
    use_range: bool = False
    fitted: int = 0
    own_flows: OwnFlows | None = None
    passes: int = 2
    iterations: int = 4
    range_scale: tuple[float, float] | None = None
    noise: float = 0.0
    scale: float = 1.0
    penalty: str = "geman-mcclure"
    robust: str = "failed"
    cut: bool = False

    def about(self, frame: int) -> Problem:
        """The problem about the reference frame ``frame``: another one where frames are uneven in time."""
        if not self.sampling.t.uneven:
            return self
        own = self.own_flows and replace(self.own_flows, sampling=self.own_flows.sampling.about(frame))
        return replace(self, sampling=self.sampling.about(frame), own_flows=own)

    def requests(self, layout: TensorLayout) -> tuple[Request, ...]:
        """What the tensor stage is asked for: the reference model's tensor, and those of the own flows."""
        own = self.own_flows.requests if self.own_flows else ()
        return (Request(self.columns, layout, self.sampling), *own)

    def mask_moments(self, layout: TensorLayout) -> MaskMoments | None:
        """The moments of cut windows that are needed; estimators that weigh windows anew take those of cells."""
        if not self.cut or ESTIMATORS[self.estimator].weighs:
            return None
        return MaskMoments.of(self.requests(layout))

    @property
    def unknowns(self) -> int:
        """Components of (N, Ω, A) that are measured."""
        return self.own_flows.unknowns if self.own_flows else self.fitted

    @property
    def terms(self) -> tuple[str, ...]:
        """Geometry terms: the offsets of the disparity that enter the surface fit."""
        if not self.camera_axes:
            return ()
        return tuple(o for o in ("1", "x", "y", "t") if self.columns.index("x", o) is not None)

    @property
    def brightness(self) -> tuple[str, ...]:
        """Offsets of the brightness change in time that are measured."""
        if "t" not in self.columns.solutions:
            return ()
        return tuple(o for o in ("1", "x", "y", "t") if self.columns.index("i", o) is not None)

    @property
    def world_brightness(self) -> tuple[str, ...]:
        """Of these, the ones that geometry (for the slopes) and motion (for the trend) carry into the world (4.28)."""
        if not {"x", "y"} <= {*self.brightness} & {*self.terms}:
            return ()
        return tuple(o for o in self.brightness if o in ("x", "y") or (o == "t" and self.unknowns))

    @property
    def camera_axes(self) -> tuple[str, ...]:
        """Camera axes with a solution."""
        return tuple(a for a in self.columns.solutions if a != "t")


def unknowns_of(motion: str, columns: ColumnSet, all_cameras: bool = False) -> int:
    """How many of (N, Ω, A) the flow of one camera, or of all cameras, determines.

    Without offsets along x, y the velocity along Z is not seen and taken as zero; nor is, from one camera, the
    acceleration along Z: it enters as ``A_X - x/f A_Z``, ``A_Y - y/f A_Z`` only.
    """
    if columns.index("x", "x") is None:
        return 2
    return {"translation": 3, "rotation": 6, "acceleration": 9 if all_cameras else 8}[motion]


BRIGHTNESS_MAPS = {"1": "brightness_t", "x": "brightness_tx", "y": "brightness_ty", "t": "brightness_tt"}
WORLD_MAPS = {"x": "brightness_world_x", "y": "brightness_world_y", "t": "brightness_world_tt"}
"""Offset of the brightness change in time -> name of its map, in the image and on the material."""
