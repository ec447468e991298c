"""leafflow-ti: dense depth, surface normals and 3D motion of leaves from camera-grid image sequences.

    import leafflow_ti as lf
    field = lf.estimate("capture.toml", model="affine-4d", window=65, stride=4)
    field["depth"], field["depth_std"], field.status

Importing the package starts no compute engine and loads no heavy module; the names below load theirs when first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from leafflow_ti.api import estimate, plan_run
    from leafflow_ti.arriving import follow
    from leafflow_ti.capture import Capture, Geometry, capture_from_array, open_capture
    from leafflow_ti.config import RunConfig, load_config
    from leafflow_ti.cumulative import track_growth
    from leafflow_ti.engines import release
    from leafflow_ti.exporters import export
    from leafflow_ti.field import Field
    from leafflow_ti.inspection import check
    from leafflow_ti.leaf_axes import leaf_coordinates
    from leafflow_ti.regions import RegionTable, measure_regions
    from leafflow_ti.report import write_report
    from leafflow_ti.results import ResultStore
    from leafflow_ti.rig import Rig, plan_rig
    from leafflow_ti.surface_growth import measure_growth
    from leafflow_ti.tracking import track
    from leafflow_ti.tracks import Tracks

__version__ = "0.1.0"

_HOME = {
    "estimate": "api", "plan_run": "api", "run": "runs",
    "Capture": "capture", "Geometry": "capture", "capture_from_array": "capture", "open_capture": "capture",
    "RunConfig": "config", "load_config": "config", "Field": "field", "ResultStore": "results",
    "check": "inspection", "Rig": "rig", "plan_rig": "rig",
    "release": "engines", "Tracks": "tracks", "track": "tracking", "track_growth": "cumulative",
    "leaf_coordinates": "leaf_axes", "export": "exporters", "RegionTable": "regions", "measure_regions": "regions",
    "measure_growth": "surface_growth", "write_report": "report", "follow": "arriving",
}  # fmt: skip
__all__ = [
    "Capture", "Field", "Geometry", "RegionTable", "ResultStore", "Rig", "RunConfig", "Tracks", "capture_from_array",
    "check", "estimate", "export", "follow", "leaf_coordinates", "load_config", "measure_growth", "measure_regions",
    "open_capture", "plan_rig", "plan_run", "release", "run", "track", "track_growth", "write_report",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'leafflow_ti' has no attribute '{name}'")
    return getattr(import_module(f"leafflow_ti.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
