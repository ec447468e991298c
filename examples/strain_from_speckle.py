"""Strain of a specimen from images of its speckles. Run: ``python examples/strain_from_speckle.py``.

Five images of a specimen that is drawn along x by 0.1 % per image and gets narrower by 0.03 %; here they are made, with
1 % noise, yours come from a camera. Strain is the slope of the flow, by a fit over the specimen.
"""

import numpy as np

from leafflow_ti.backend import optical_flow

ALONG, ACROSS = 1e-3, -3e-4
SIZE = 160

random = np.random.default_rng(1)
y, x = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
places = random.uniform(-SIZE * 0.6, SIZE * 0.6, (2, 4000))
grey = random.uniform(20, 80, 4000)


def image(k: int) -> np.ndarray:
    """The specimen ``k`` images behind the middle one: round speckles of 1.5 px, moved, not deformed."""
    seen = np.full((SIZE, SIZE), 30.0)
    for px, py, g in zip(places[0] * (1 + k * ALONG), places[1] * (1 + k * ACROSS), grey, strict=True):
        cols, rows = (slice(max(0, int(p + SIZE / 2) - 7), max(0, int(p + SIZE / 2) + 8)) for p in (px, py))
        apart = (x[rows, cols] - px) ** 2 + (y[rows, cols] - py) ** 2
        seen[rows, cols] += g * np.exp(-apart / (2 * 1.5**2))
    return seen + random.normal(0, 2.55, seen.shape)


flow, std = optical_flow(np.stack([image(k) for k in range(-2, 3)]), errors=True)

inner = slice(12, -12)  # windows are cut at the border
columns = np.stack([np.ones_like(x), x, y], axis=-1)[inner, inner].reshape(-1, 3)
for name, component, column, true in (("along x", 0, 1, ALONG), ("along y", 1, 2, ACROSS)):
    measured = np.linalg.lstsq(columns, flow[component][inner, inner].ravel(), rcond=None)[0][column]
    print(f"strain {name}: measured {1e6 * measured:7.1f} µε per image, true {1e6 * true:7.1f}")
print(f"flow: standard error {std[:, inner, inner].mean():.4f} px per image")
