"""leafflow-ti: dense depth, surface normals and 3D motion of leaves from camera-grid image sequences."""

__version__ = "0.1.0"
