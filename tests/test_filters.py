"""Filter sets: normalised, matched, as their table says."""

from __future__ import annotations

import numpy as np
import pytest

from leafflow_ti.filters import FILTER_SETS, HALFWAY_SETS, FilterSet, filter_set


def gain_error(filters: FilterSet, highest: float) -> float:
    """Largest relative error of the derivative of what is smoothed, up to a frequency [rad/sample]."""
    ω = np.linspace(0.02, highest, 200)
    waves = np.exp(1j * np.outer(ω, filters.offsets))
    gain = (waves @ filters.kernel(True)) / (1j * ω * (waves @ filters.kernel(False)))
    return float(np.abs(gain - 1).max())


@pytest.mark.parametrize("blur", [0.0, 1.5])
@pytest.mark.parametrize("name", [*FILTER_SETS, *HALFWAY_SETS])
def test_sets_are_normalised(name: str, blur: float) -> None:
    filters = filter_set(name).blurred(blur)
    D, B, s = filters.kernel(True), filters.kernel(False), filters.offsets
    assert s @ D == pytest.approx(1, abs=1e-12)
    assert D.sum() == pytest.approx(0, abs=1e-12)
    assert B.sum() == pytest.approx(1, abs=1e-12)
    assert np.allclose(D, -D[::-1])
    assert np.allclose(B, B[::-1])


@pytest.mark.parametrize(
    ("name", "highest", "most"),
    [("3", 1.8, 0.015), ("5", 1.8, 2.7e-4), ("7", 1.8, 1.6e-5), ("9", 2.4, 2.5e-7), ("11", 2.6, 1e-6),
     ("2", 0.5, 0.022), ("4", 1.0, 1.6e-5)],
)  # fmt: skip
def test_derivative_and_smoothing_match(name: str, highest: float, most: float) -> None:
    """As far as the module says; the blur is part of both."""
    assert gain_error(filter_set(name), highest) < most
    assert gain_error(filter_set(name).blurred(1.0), highest) < most


def test_longer_sets_are_better_further() -> None:
    errors = [gain_error(filter_set(name), 2.4) for name in ("5", "7", "9", "11")]
    assert errors[0] > 5 * errors[1] > 25 * errors[2] > 25 * errors[3]
