"""Numbers that the per-pixel stages decide by, and why they are what they are."""

from __future__ import annotations

from leafflow_ti.kernels.numbers import Penalty
from leafflow_ti.stages.estimators import ESTIMATORS

PENALTIES = {
    "lorentzian": Penalty.LORENTZIAN, "geman-mcclure": Penalty.GEMAN_MCCLURE, "truncated": Penalty.TRUNCATED,
}  # fmt: skip
RIDGE = {"f64": 1e-13, "f32": 1e-7}
GUARDED = {1: 2, 2: 4, 3: 4}
"""Vectors that the inverse iteration carries for so many solutions; the guards are what makes it converge."""
GAP = {"f64": 1e-6, "f32": 1e-3}
DENOISE = {name: estimator.denoise for name, estimator in ESTIMATORS.items()}
"""Share of the gradients' own noise that the covariances take out of J_ff."""
MODEL_ERROR = {"1": 0.0, "x": 0.05, "y": 0.05, "sx": 0.03, "sy": 0.03, "t": 0.05, "range": 0.03}
TURNING_ERROR = 0.01
"""What each equation of the motion fit leaves out: a share of the sizes of its terms, by the offset of its row; and
of the mixed derivatives ``a_s`` and ``b_t`` also a share of ``nu |Ω| (1 + ZX² + ZY²)^1/2``.

Noise is not all: on steep and turning surfaces the affine model's derivatives are off by some per cent without any, the
mixed ones in proportion to the turning (a_s by .0026 of the above on a 60° face), while the flow itself is not.
Weights that know of the noise alone stake everything on the derivatives where images are good. That ``a_s`` and ``b_t``
measure one derivative from the same noise, which the weights leave out, is one more reason for a share.
"""
STEP_SIZE = {"f64": 1e-7, "f32": 3e-3}
"""Relative step of the forward differences of the motion rows: about the root of the rounding."""
MIN_STRUCTURE = {"f64": 8e-31, "f32": 2e-13}
"""Least energy of the gradient relative to that of the image, (8 eps)²: below, it is the rounding of a constant."""
MIN_MASS = 0.1
"""Least share of the window's weight that must be seen: a corner pixel has 1/4, less what filters take, a tip of a
leaf less. Windows of .1 to .2 are as good as their error bars say, and errors of leaves behind others a tenth of the
search's, which would take their place; Tsukuba alone would be better by .4 % of its pixels with .2."""
LEAST_SHARE = 5e-5
"""Share of the gradient's mean energy in a direction that is no texture, however little noise there is: what filters
and rounding leave."""
MISFIT_PX = 0.05
"""Misfit of the brightness constraint that is usual without noise, as a displacement."""
MAX_RESIDUAL_PX = 0.5
"""Root mean square misfit of the brightness constraint, as a displacement, above which a window is incoherent."""

SCALE_START = 1.0
"""Of the penalty's σ², per mean squared residual of the plain fit: everything counts, more or less."""
SCALE_SHRINK = 0.5
LEAST_NOISE, LEAST_PX = 2.0, 0.02
"""Least σ² of the penalty: so many variances of the noise, and what models leave out, as a displacement."""
MOST_NOISE, MOST_PX = 3.0, 0.02
"""Squared residual above which the plain fit failed, likewise."""
RELAXATION = 1.5
"""Factor of a step of over-relaxation; converges between 0 and 2."""

MAX_CONTRADICTION = 3.0
"""Mean squared difference, in error bars, between a camera's own flow and the reference's motion, above which a robust
estimate is taken to be of another surface."""
