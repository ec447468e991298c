"""The naive twin of the weighted estimators against independent truth: minimisers, invariances, exact special cases."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import estimate_bench
import numpy as np
import pytest
from reference import chain, estimators
from reference.cells import Cells
from reference.estimators import PENALTIES, Level, Schedule
from reference.sequences import affine_sequence
from scipy.optimize import minimize

from leafflow_ti.filters import filter_set
from leafflow_ti.models import MODELS, ColumnSet, column_set
from leafflow_ti.sampling import AxisSampling, Sampling, column_noise

SERIES = AxisSampling.gaussian(filter_set("3"), 3, 1.0)
DIVERGING = np.array([[0.3, 0.05, -0.02], [-0.2, 0.03, 0.04]])
CONVERGED = 60
"""Rounds after which no scheme that converges on these scenes changes in the tenth digit."""


def flow_sampling(size: int = 15, stride: int = 1) -> Sampling:
    pixel = AxisSampling.gaussian(filter_set("5"), size, 0.3 * size, stride)
    return Sampling(pixel, pixel, t=SERIES)


def columns_of(model: str, sampling: Sampling, brightness: str = "none") -> ColumnSet:
    return column_set(MODELS[model], brightness, sampling.camera_axes, sampling.sampled)


@functools.cache
def flow_cells(model: str = "flow-affine", stride: int = 1, exact: bool = False, noise: float = 3.0) -> Cells:
    sampling = flow_sampling(19 if stride > 1 else 15, stride)
    side = 2 * sampling.x.radius + 1
    images = affine_sequence(DIVERGING, 5, (side, side), noise=noise)
    middle = (side // 2, side // 2)
    return Cells.at(images, sampling, columns_of(model, sampling), middle, exact=exact)


@functools.cache
def boundary_cells(model: str = "flow-affine") -> Cells:
    """The left two thirds of the window move otherwise than the right third."""
    sampling = flow_sampling()
    side = 2 * sampling.x.radius + 1
    images, other = (
        affine_sequence(flow, 5, (side, side), noise=1.0, seed=seed)
        for seed, flow in enumerate((np.array([[0.3, 0.01, 0.0], [-0.2, 0.0, 0.01]]), [[-0.5, 0, 0], [0.4, 0, 0]]))
    )
    images[..., 15:] = other[..., 15:]
    return Cells.at(images, sampling, columns_of(model, sampling), (side // 2, side // 2))


def camera_cells(exact: bool = False) -> Cells:
    sampling = estimate_bench.sampling_of("line-x", True)
    side = 2 * sampling.x.radius + 1
    images = estimate_bench.rendered(replace(estimate_bench.SCENE, noise=3.0), "line-x", (side, side))
    return Cells.at(images, sampling, columns_of("affine-4d", sampling), (side // 2, side // 2), exact=exact)


def standard_errors(cells: Cells) -> np.ndarray:
    """Standard errors of the parameters [n_flow, k], were the noise of all samples independent."""
    k = cells.columns.n_time_like
    P = estimators.plain(cells, "tls-equilibrated").P
    variance = chain.noise_variance(cells.tensor, P, cells.columns, cells.noise)
    inverse = np.linalg.inv(cells.tensor[:-k, :-k])
    mean_square = float(np.sum(cells.w**2))  # of weights that add up to 1
    return np.sqrt(np.outer(np.diag(inverse), variance * gains(cells, P)) * mean_square)


def objective(cells: Cells, P: np.ndarray, c: np.ndarray) -> float:
    """``Σ p^T J_b p / (p^T C_b p)``, both means over the solutions of what ``c`` [k] scales to the window's noise."""
    p = estimators.full(P)
    J, C = (np.einsum("ik,bij,jk,k->b", p, X, p, 1 / c) for X in (cells.J, cells.C))
    return float(np.sum(J / C))


def gains(cells: Cells, P: np.ndarray) -> np.ndarray:
    p = estimators.full(P)
    return np.einsum("ik,i,ik->k", p, cells.noise, p)


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize(("size", "stride"), [(11, 1), (19, 2), (37, 4), (29, 3)])
def test_cells_add_up_to_the_window(size: int, stride: int, exact: bool) -> None:
    """Single pixels, blocks that share samples, blocks side by side; with pixels that do not count."""
    sampling = flow_sampling(size, stride)
    assert (sampling.x.blocks is None) == (stride == 1)
    columns = columns_of("flow-quadratic", sampling, "spatial")
    side = 2 * sampling.x.radius + 1
    images = np.random.default_rng(1).random((5, 1, 1, side, side))
    valid = np.ones((5, side, side), bool)
    valid[:, : side // 3], valid[2, side // 2, -4] = False, False
    middle = (side // 2, side // 2)
    cells = Cells.at(images, sampling, columns, middle, valid, exact)
    blocks = len(sampling.x.blocked.weights) ** 2
    assert cells.w.shape == ((blocks if not exact else 3 * sampling.x.size**2),)
    wanted = chain.structure_tensor(images, sampling, columns, [middle], valid)[0]
    size_of = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(cells.tensor / np.outer(size_of, size_of), wanted / np.outer(size_of, size_of), 0, 1e-13)
    seen = chain.filters_see(valid, sampling)[1:4, 2:-2, 2:-2]
    assert cells.w.sum() == pytest.approx(np.einsum("i,j,k,ijk", *(sampling.axis(a).weights for a in "tyx"), seen))
    whole = Cells.at(images, sampling, columns, middle, exact=exact)
    assert np.array_equal(whole.C, cells.C)  # noise is that of all samples
    scale = np.sqrt(column_noise(sampling, columns))
    noise = np.tensordot(whole.w, whole.C, 1) / np.outer(scale, scale)
    np.testing.assert_allclose(noise, np.eye(columns.n), 0, 1e-12)


@pytest.mark.parametrize(("model", "cameras"), [("flow-quadratic", False), ("affine-4d", True)])
def test_noise_of_the_samples_is_what_unit_images_leave(model: str, cameras: bool) -> None:
    """The data vector is linear in the images: its noise covariance is the sum over the response to every pixel."""
    pixel = AxisSampling.gaussian(filter_set("3"), 3, 1.0)
    sampling = Sampling(pixel, pixel, sx=SERIES if cameras else AxisSampling(), t=SERIES)
    columns = columns_of(model, sampling, "spatial")
    shape = (5, 1, 5 if cameras else 1, 5, 5)
    found = 0.0
    for at in product(*map(range, shape)):
        unit = np.zeros(shape)
        unit[at] = 1
        (d,), _ = chain.window_of(unit, sampling, columns, (2, 2))
        flat = d.reshape(columns.n, -1).T
        found = found + flat[:, :, None] * flat[:, None, :]
    wanted = Cells.at(np.zeros(shape), sampling, columns, (2, 2), exact=True).C
    np.testing.assert_allclose(found, wanted, atol=1e-14)


@pytest.mark.parametrize("exact", [False, True], ids=["pixels", "samples"])
@pytest.mark.parametrize("stride", [1, 2])
def test_fns_minimises_residual_over_noise(stride: int, exact: bool) -> None:
    """Against a general minimiser that knows the sum alone; with strong divergence, where TLS is another solution."""
    cells = flow_cells(stride=stride, exact=exact)
    start, errors = estimators.plain(cells, "tls-equilibrated").P, standard_errors(cells)
    found = estimators.fns(cells, CONVERGED).P

    def value(q: np.ndarray) -> float:
        P = start + errors * q[:, None]
        return objective(cells, P, gains(cells, P))

    best = minimize(value, np.zeros(len(start)), method="BFGS", options={"gtol": 1e-9})
    wanted = start + errors * best.x[:, None]
    assert np.max(np.abs(wanted - start) / errors) > 0.01
    assert np.max(np.abs(found - wanted) / errors) < 1e-4


@pytest.mark.parametrize("exact", [False, True], ids=["pixels", "samples"])
def test_several_solutions_lie_near_the_minimum_of_their_common_sum(exact: bool) -> None:
    """Two solutions that share their weights are null vectors of one matrix X only if their residuals are of one level.

    Else the eigenvalues of FNS are nearest to zero, not zero, and the minimiser solves ``X_ff p = -X_ft``: found by
    iteration, confirmed by the gradient. All schemes lie within a tenth of a standard error of it.
    """
    cells = camera_cells(exact)
    errors, k = standard_errors(camera_cells()), cells.columns.n_time_like
    P = estimators.plain(cells, "tls-equilibrated").P
    for _ in range(CONVERGED):
        X = estimators.fundamental(cells, P)
        P = -np.linalg.solve(X[:-k, :-k], X[:-k, -k:])
    c = gains(cells, P)

    def slope(at: np.ndarray) -> np.ndarray:
        def value(q: np.ndarray) -> float:
            return objective(cells, at + errors * q.reshape(P.shape), c)

        return np.array([(value(q) - value(-q)) / 0.2 for q in 0.1 * np.eye(P.size)])

    others = [estimators.fns(cells, CONVERGED).P, estimators.sampson(cells, CONVERGED).P, estimators.for3(cells, 4).P]
    for other in others:
        assert np.max(np.abs(slope(P))) < 1e-3 * np.max(np.abs(slope(other)))
        assert np.max(np.abs(other - P) / errors) < 0.1


def rescaled(cells: Cells, factors: np.ndarray) -> Cells:
    outer = np.outer(factors, factors)
    return replace(cells, J=cells.J * outer, C=cells.C * outer, noise=cells.noise * factors**2)


def test_for3_does_not_know_units() -> None:
    for cells in (flow_cells(), camera_cells()):
        k = cells.columns.n_time_like
        factors = np.exp(np.random.default_rng(2).normal(size=cells.columns.n))
        factors[-k:] = factors[-1]
        found, other = (estimators.for3(c, 3).P for c in (cells, rescaled(cells, factors)))
        assert np.max(np.abs(other * factors[:-k, None] / factors[-1] - found) / standard_errors(cells)) < 1e-8


def test_units_matter_to_sampson_but_not_to_converged_fns() -> None:
    cells = flow_cells()
    errors = standard_errors(cells)
    for scheme, changes in ((estimators.sampson, True), (estimators.fns, False)):
        one, *others = (scheme(cells, CONVERGED, scale).P for scale in (1.0, 0.3, 2.0))
        for other in others:
            difference = np.max(np.abs(other - one) / errors)
            assert difference > 1e-3 if changes else difference < 1e-6, scheme.__name__


def test_the_scale_is_the_unit_of_the_coordinates() -> None:
    """Raw TLS at scale 2 is raw TLS on columns whose offsets are counted in half pixels."""
    cells = flow_cells()
    found = estimators.plain(cells, "tls", 2.0).P
    columns = [c.offset for c in cells.columns.columns]
    factors = np.array([2.0 if o in ("x", "y") else 1.0 for o in columns])
    other = estimators.plain(rescaled(cells, factors), "tls").P * factors[:-1, None]
    np.testing.assert_allclose(found, other, rtol=1e-10)


def test_where_all_cells_are_equally_noisy_nothing_is_weighted() -> None:
    """Columns without offsets: every covariance is the same, FOR III and FNS are the equilibrated TLS."""
    cells = flow_cells("flow")
    wanted = estimators.plain(cells, "tls-equilibrated").P
    for scheme in (estimators.for3, estimators.fns):
        found = scheme(cells, CONVERGED)
        np.testing.assert_allclose(found.P, wanted, rtol=1e-9)
        np.testing.assert_allclose(found.weights, 1.0, rtol=1e-12)


FIXED = Schedule(start=0.0, shrink=1.0, least=Level(1.0), translation=0, narrow=0, wide=400, noise=6.0)
"""σ² is the noise variance from the first round on."""


def penalised(cells: Cells, penalty: str, P: np.ndarray, square: float, ols: bool) -> float:
    rho = PENALTIES[penalty][1]
    k = cells.columns.n_time_like
    if ols:
        return float(cells.w @ rho(estimators.residuals(cells, P, cells.noise[-k:]) / square))
    return float(cells.w @ rho(estimators.residuals(cells, P) / estimators.relative_noise(cells, P) / square))


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("scheme", ["irls", "sor", "tls"])
def test_robust_schemes_end_where_the_penalty_is_stationary(scheme: str, penalty: str) -> None:
    """In a window with two motions; for TLS in the model whose noise is the same everywhere, where it is exact."""
    cells = boundary_cells("flow" if scheme == "tls" else "flow-affine")
    schemes: dict[str, Callable[[], estimators.Found]] = {
        "irls": lambda: estimators.robust_ols(cells, penalty, FIXED),
        "sor": lambda: estimators.robust_ols_sor(cells, penalty, FIXED, 1.5),
        "tls": lambda: estimators.robust_tls(cells, penalty, FIXED),
    }
    found, errors = schemes[scheme](), standard_errors(cells)
    assert 0.05 < np.mean(found.weights < 0.5) < 0.8  # some outliers, not all

    def slope(P: np.ndarray) -> np.ndarray:
        def value(q: np.ndarray) -> float:
            return penalised(cells, penalty, P + errors * q[:, None], FIXED.noise, scheme != "tls")

        steps = 1e-4 * np.eye(len(P))
        return np.array([(value(q) - value(-q)) / 2e-4 for q in steps])

    plain = estimators.plain(cells, "tls-equilibrated" if scheme == "tls" else "ols").P
    assert np.max(np.abs(slope(found.P))) < 1e-5 * np.max(np.abs(slope(plain)))


@pytest.mark.parametrize("penalty", PENALTIES)
def test_the_weight_is_the_derivative_of_the_penalty(penalty: str) -> None:
    psi, rho = PENALTIES[penalty]
    u = np.array([0.0, 0.3, 0.9, 1.2, 5.0, 100.0])
    np.testing.assert_allclose(psi(u), (rho(u + 1e-6) - rho(u - 1e-6)) / 2e-6, rtol=1e-5, atol=1e-9)


GRADUATED = Schedule(
    start=1.0, shrink=0.7, least=Level(2.0), translation=4, narrow=4, wide=10, noise=1.0, width=0.3
)  # fmt: skip


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("scheme", ["irls", "sor", "tls"])
def test_the_larger_motion_wins(scheme: str, penalty: str) -> None:
    """The plain fit mixes both motions; graduated σ leads to the one that holds two thirds of the window."""
    cells = boundary_cells()
    if scheme == "sor":
        found = estimators.robust_ols_sor(cells, penalty, replace(GRADUATED, wide=60), 1.5)
    else:
        found = (estimators.robust_ols if scheme == "irls" else estimators.robust_tls)(cells, penalty, GRADUATED)
    wanted = np.array([0.3, -0.2])
    plain = estimators.plain(cells, "tls-equilibrated").P
    index = [cells.columns.index("x"), cells.columns.index("y")]
    error, before = (np.hypot(*(P[index, 0] - wanted)) for P in (found.P, plain))
    assert error < 0.2 * before
    assert error < 0.05


def test_translation_comes_first() -> None:
    cells = boundary_cells()
    for scheme in (estimators.robust_ols, estimators.robust_tls):
        still = scheme(cells, "lorentzian", replace(GRADUATED, narrow=0, wide=0)).P
        moving = [i for i, c in enumerate(cells.columns.columns[:-1]) if c.offset == "1"]
        assert np.all(still[moving] != 0)
        assert np.count_nonzero(still) == len(moving) == 2


def test_the_middle_of_the_window_chooses() -> None:
    """A window whose middle holds less than half of it: the larger motion wins, but for rounds of a narrow window."""
    sampling = flow_sampling(31)
    side = 2 * sampling.x.radius + 1
    middle, border = np.array([[0.3, 0, 0], [-0.2, 0, 0]]), np.array([[-0.5, 0, 0], [0.4, 0, 0]])
    images, other = (
        affine_sequence(flow, 5, (side, side), noise=1.0, seed=seed) for seed, flow in enumerate((border, middle))
    )
    strip = slice(side // 2 - 4, side // 2 + 5)
    images[..., strip] = other[..., strip]
    cells = Cells.at(images, sampling, columns_of("flow", sampling), (side // 2, side // 2))
    for width, wanted in ((0.3, middle), (100.0, border)):
        found = estimators.robust_ols(cells, "geman-mcclure", replace(GRADUATED, width=width)).P
        assert np.hypot(*(found[:, 0] - wanted[:, 0])) < 0.05


def test_sigma_falls_to_its_least() -> None:
    """From ``start`` times the residual of the translation by ``shrink`` a round."""
    cells = boundary_cells("flow")
    energy = 0.5 * (cells.tensor[0, 0] + cells.tensor[1, 1])
    least = 2.0 + 0.05**2 * energy / cells.noise[-1]
    assert least > 3.0
    assert Level(2.0, 0.05).of(cells, 1.0) == pytest.approx(least)
    first = (cells.tensor @ np.append(estimators.plain(cells, "ols").P, 1.0))[-1] / cells.noise[-1]
    start, measures = estimators.plain(cells, "ols").P, estimators.plain_measures(cells)
    for rounds in (0, 1, 30):
        asked: list[float] = []

        def psi(u: np.ndarray, asked: list[float] = asked) -> np.ndarray:
            asked.append(float(u[0]))
            return np.ones_like(u)

        schedule = replace(GRADUATED, least=Level(2.0, 0.05), translation=1, narrow=0, wide=rounds, width=1e6)
        estimators.graduated(cells, start, measures, psi, estimators.least_squares, schedule)
        squares = [measures(start)[0][0] / u for u in asked]  # with weights 1 the solution stays
        assert squares == pytest.approx([max(first * 0.7**n, least) for n in range(rounds + 1)])
