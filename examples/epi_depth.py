"""Depth of a light field: disparity in its epipolar plane images, with error bars: ``python examples/epi_depth.py``.

Nine cameras in a row, 4 mm apart, see a slanted wall; here its views are made, yours come from files.
"""

import numpy as np

from leafflow_ti.backend import epi_disparity
from leafflow_ti.synthetic.affine_images import affine_images

FOCAL_PX, BASELINE_MM, FOCUS_MM = 1400.0, 4.0, 1000.0  # views are shifted so that disparity is 0 at the focus

# Views [9, y, x] with 1 % noise; disparity runs from -.7 to .7 px per view along x.
views, truth = affine_images((160, 200), np.arange(9) - 4, (0.0, 0.0), [[0.007, 0.0], [0.0, 0.0]], noise=0.01)

disparity, std = epi_disparity(views.astype(np.float32), errors=True)


def depth(seen: np.ndarray) -> np.ndarray:
    """Depth [mm] of a disparity [px/view]: the total one is ``-f b / Z``."""
    return -FOCAL_PX * BASELINE_MM / (seen - FOCAL_PX * BASELINE_MM / FOCUS_MM)


error = depth(disparity) - depth(truth[0])
bar = depth(disparity) ** 2 / (FOCAL_PX * BASELINE_MM) * std  # |dZ/dd| = Z² / (f b)
print(f"depth {depth(disparity).min():.0f} to {depth(disparity).max():.0f} mm")
print(f"root mean square error {np.sqrt(np.mean(error**2)):.2f} mm, standard error {np.sqrt(np.mean(bar**2)):.2f} mm")
