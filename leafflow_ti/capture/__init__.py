"""Captures: image files on disk (or arrays) as lazy windows ``[t, sy, sx, y, x]`` with their geometry."""

from leafflow_ti.capture.capture import (
    DEFAULT_CACHE_BYTES,
    ArrayCapture,
    Capture,
    FileCapture,
    Geometry,
    capture_from_array,
    open_capture,
)
from leafflow_ti.capture.channels import ImageInfo
from leafflow_ti.capture.description import Camera, Description, Grid, Images, Time, write_description
from leafflow_ti.capture.images import probe, read_gray
from leafflow_ti.capture.preshift import find_preshift

__all__ = [
    "DEFAULT_CACHE_BYTES",
    "ArrayCapture",
    "Camera",
    "Capture",
    "Description",
    "FileCapture",
    "Geometry",
    "Grid",
    "ImageInfo",
    "Images",
    "Time",
    "capture_from_array",
    "find_preshift",
    "open_capture",
    "probe",
    "read_gray",
    "write_description",
]
