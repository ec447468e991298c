"""Captures: image files on disk (or arrays) as lazy windows ``[t, sy, sx, y, x]`` with their geometry."""

from leafflow_ti.capture.arrivals import SETTLE_S, Arrivals
from leafflow_ti.capture.capture import Capture, Geometry
from leafflow_ti.capture.channels import ImageInfo
from leafflow_ti.capture.description import Camera, Description, Grid, Images, Time, write_description
from leafflow_ti.capture.doubts import capture_doubts
from leafflow_ti.capture.images import probe, read_gray
from leafflow_ti.capture.opening import DEFAULT_CACHE_BYTES, capture_from_array, open_capture
from leafflow_ti.capture.preshift import UnclearDisparity, find_preshift
from leafflow_ti.capture.sources import ArrayCapture, FileCapture
from leafflow_ti.capture.spread import anything_fits, one_preshift_serves

__all__ = [
    "DEFAULT_CACHE_BYTES",
    "SETTLE_S",
    "ArrayCapture",
    "Arrivals",
    "Camera",
    "Capture",
    "Description",
    "FileCapture",
    "Geometry",
    "Grid",
    "ImageInfo",
    "Images",
    "Time",
    "UnclearDisparity",
    "anything_fits",
    "capture_doubts",
    "capture_from_array",
    "find_preshift",
    "one_preshift_serves",
    "open_capture",
    "probe",
    "read_gray",
    "write_description",
]
