"""The tables of a plan as plain arrays, for implementations of the three stages in other frameworks.

For models of the reference camera's row without intensity columns and centred squares, with 5-tap filters and 5
cameras and frames under the window: ``affine-4d`` as it is by default.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.models import AXES
from leafflow_ti.plan import Plan
from leafflow_ti.sampling import AxisSampling

Array = NDArray[Any]
CHANNELS = ("x", "y", "sx", "t")


@dataclass(frozen=True)
class Tables:
    """What is computed from what.

    ``pairs`` [n, 4]: two channels, first map, number of powers of the camera offset. ``tall`` [n, 3]: map, power of t,
    power of y. ``wide`` [entries, 2]: power of x, entry; those of tall image i are first[i]..first[i + 1]. ``lower``:
    entry of each element of the lower triangle.
    """

    pairs: Array
    n_maps: int
    tall: Array
    first: Array
    wide: Array
    lower: Array

    @classmethod
    def of(cls, plan: Plan) -> Tables:
        """Raises ValueError for a model that these tables do not cover."""
        columns, sampling = plan.problem.columns, plan.problem.sampling
        small = all(sampling.axis(a).filter_radius == 2 for a in ("x", "y", "sx", "t"))
        five = sampling.sx.size == 5 == sampling.t.size
        if columns.channels != CHANNELS or columns.at_centre or not (small and five):
            raise ValueError("the twins cover affine-4d with 5 taps, 5 samples and no intensity columns")
        at = [AXES.index(a) for a in ("sx", "t", "y", "x")]
        powers: dict[tuple[str, str], int] = {}
        for m in plan.layout.moments:
            powers[m.channels] = max(powers.get(m.channels, 0), m.exponents[at[0]] + 1)
        begin = dict(zip(powers, np.cumsum([0, *powers.values()]).tolist(), strict=False))
        pairs = [(*map(CHANNELS.index, pair), begin[pair], n) for pair, n in powers.items()]
        tall: dict[tuple[int, int, int], list[tuple[int, int]]] = {}
        for entry, ((m, _),) in enumerate(plan.layout.entries):
            s, t, y, x = (m.exponents[i] for i in at)
            tall.setdefault((begin[m.channels] + s, t, y), []).append((x, entry))
        return cls(
            np.array(pairs), sum(powers.values()), np.array(list(tall)),
            np.cumsum([0, *(len(w) for w in tall.values())]), np.array([w for ws in tall.values() for w in ws]),
            np.array(plan.layout.lower),
        )  # fmt: skip


def window_powers(axis: AxisSampling, multiple: int) -> Array:
    """Window times the powers 0, 1, 2 of the offset [3, taps], padded with zeros to a multiple of taps."""
    weights = np.stack([axis.window(power) for power in range(3)])
    padding = -weights.shape[1] % multiple
    return np.asarray(np.pad(weights, ((0, 0), (0, padding))).astype(np.float32))
