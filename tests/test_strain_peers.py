"""The comparison with other strain programs: its resolutions, its images, what it does without the programs."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from perf import strain_peers
from perf.speckle import speckle_image
from perf.strain_peers import METHODS, OURS, Errors, Measured, Method, Triple

WAVES = 2 * np.pi / np.array([400.0, 150.0, 60.0])


def slope(x: np.ndarray, u: np.ndarray, weights: np.ndarray) -> float:
    """Of the line through points (x, u)."""
    return float(np.polyfit(x, u, 1, w=np.sqrt(weights))[0])


def hats(x: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Linear shape functions [nodes, x]."""
    return np.array([np.interp(x, nodes, np.eye(len(nodes))[i]) for i in range(len(nodes))])


def test_shares_of_a_strain_are_those_of_least_squares() -> None:
    """Displacements ``sin(k x) / k``, whose strain at 0 is 1."""
    x = np.arange(-32, 33)
    weights = np.exp(-0.5 * (x / 19.0) ** 2)
    expected = [slope(x, np.sin(k * x) / k, weights) for k in WAVES]
    np.testing.assert_allclose(strain_peers.window_transfer(WAVES, 65), expected, rtol=1e-9)

    centres, inner = np.arange(-20, 21, 5), np.arange(-15, 16)
    means = [np.sin(k * (centres[:, None] + inner)).mean(axis=1) / k for k in WAVES]
    expected = [slope(centres, u, np.ones(9)) for u in means]
    np.testing.assert_allclose(strain_peers.subset_transfer(WAVES, 31, 5, 9), expected, rtol=1e-9)

    nodes = 47 * (np.arange(40) - 19.5)  # the middle of an element is at 0
    fine = np.linspace(nodes[0], nodes[-1], 60_001)
    shapes = hats(fine, nodes)
    fits = [np.linalg.lstsq(shapes.T, np.sin(k * fine) / k, rcond=None)[0] for k in WAVES]
    expected = [(u[20] - u[19]) / 47 for u in fits]
    np.testing.assert_allclose(strain_peers.element_transfer(WAVES, 47), expected, rtol=1e-4)


def test_settings_are_matched() -> None:
    for method in METHODS:
        if method.gauge:
            ours = Method(OURS, {"window": method.gauge}, method.gauge)
            assert method.resolution == pytest.approx(ours.resolution, rel=0.04), method.label


def test_speckles_are_stretched() -> None:
    """What the pixels of a material point show changes by nothing but their area: by rows, then along both axes."""
    still, wide = (speckle_image(0.0, 0, (30, 201), (e, 0.0)) for e in (0.0, 0.02))
    x = np.arange(201.0)
    at = 100 + 0.98 * (x - 100) + 0.02**2 * (x - 100)
    for row in (3, 20):
        expected = np.interp(at, x, still[row])
        assert np.corrcoef(wide[row], expected)[0, 1] > 0.98
        assert np.corrcoef(wide[row, 150:], still[row, 150:])[0, 1] < 0.9


def test_strain_of_speckles_is_measured() -> None:
    """8-bit rounding alone: within what error bars say."""
    triple = strain_peers.made_triple(0.0, 0)
    errors = Errors(Method(OURS, {"window": 65}, 65))
    errors.add(triple, strain_peers.measure_ours(triple, errors.method, 16, 1))
    for name, found in errors.rate.items():
        bar = errors.bars[name][0].mean()
        assert np.abs(found[0].mean()) < bar, name
        assert found[0].std() < 1.4 * bar, name
    assert errors.rms < 15
    assert strain_peers.rms(errors.moved[0]) < 1e-3


def test_errors_are_those_of_the_middle_of_the_image() -> None:
    """One point outside, two inside, whose rates are 3 and 4 µε off and whose displacements are right."""
    triple = Triple(np.zeros((3, 200, 300), np.uint8), (1e-3, -2e-3), anchored=True)
    x, y = np.array([10.0, 100.0, 200.0]), np.array([100.0, 100.0, 60.0])
    rate = triple.rate + 1e-6 * np.array([1e6, 3.0, 4.0])[:, None, None] * np.eye(2)
    errors = Errors(Method(OURS, {"window": 65}, 65))
    errors.add(triple, Measured(x, y, triple.displacement(x, y), rate, triple.total[None], 1.0))
    np.testing.assert_allclose(errors.rate["strain_yy"][0], [3.0, 4.0], rtol=1e-6)
    np.testing.assert_allclose(errors.total["strain_xx"][0], 0.0, atol=1e-9)
    assert errors.rms == pytest.approx(np.sqrt(2 * 25 / 6))
    assert strain_peers.rms(errors.moved[0]) < 1e-12


def test_without_a_program_the_reason_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho 'muDIC is not installed' >&2\nexit 3\n")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    monkeypatch.delenv(strain_peers.VARIABLE, raising=False)
    triple = Triple(np.zeros((3, 100, 100), np.uint8), (0.0, 0.0), anchored=True)
    found = strain_peers.pooled(Method("muDIC", {"element": 24}, 33), [triple], 8)
    assert isinstance(found, str)
    assert "muDIC is not installed" in found
    assert strain_peers.VARIABLE in found


@pytest.mark.parametrize("program", ["muDIC", "pyvale"])
def test_programs_measure_the_same_strain(program: str) -> None:
    """In the signs, axes and units that ours has."""
    method = next(m for m in METHODS if m.program == program and m.gauge == 65)
    errors = strain_peers.pooled(method, [strain_peers.made_triple(0.0, 0)], 16)
    if isinstance(errors, str) and "is not installed" in errors:
        pytest.skip(errors)
    assert isinstance(errors, Errors), errors
    assert errors.rms < 30
    assert strain_peers.rms(errors.moved[0]) < 3e-3
