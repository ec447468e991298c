"""Prefilters of the backend beside their twin."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from reference.prefilter import prefilter

from leafflow_ti import backend
from leafflow_ti.errors import ConfigError


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 2e-5), (np.float64, 1e-12)])
@pytest.mark.parametrize("kind", ["highpass", "homomorphic"])
def test_images_and_masks(kind: str, dtype: Any, tolerance: float) -> None:
    """Tolerance: a few dozen roundings of grey values up to 9."""
    images = np.random.default_rng(2).uniform(1.0, 9.0, (2, 2, 30, 41)).astype(dtype)
    mask = np.ones((30, 41), bool)
    mask[10:15, 20:] = False
    images[1, 0, 3, 4] = np.nan
    found = getattr(backend, kind)(images, 2.0, mask=mask)
    assert found.dtype == dtype
    for at in np.ndindex(2, 2):
        wanted = prefilter(np.where(mask, images[at].astype(np.float64), np.nan), kind, 2.0)
        np.testing.assert_allclose(found[at], wanted, atol=tolerance)


def test_an_image_into_out() -> None:
    image = np.random.default_rng(2).uniform(1.0, 9.0, (20, 21))
    out = np.empty((21, 20)).T
    assert backend.highpass(image, 1.5, out=out) is out
    np.testing.assert_array_equal(out, backend.highpass(image, 1.5))


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: backend.highpass(np.ones(3), 1.0), backend.ArrayError, r"\[\.\.\., y, x\]"),
        (lambda: backend.highpass(np.ones((3, 3)), 0.0), ConfigError, "sigma is 0"),
        (lambda: backend.highpass(np.ones((3, 3)), 1.0, mask=np.ones((3, 3))), backend.ArrayError, "must be bool"),
        (lambda: backend.homomorphic(np.zeros((3, 3)), 1.0), backend.ArrayError, "grey value is 0.*highpass"),
    ],
)
def test_bad_input_is_one_line(call: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)
