"""Naive float64 twin of the whole chain: every sum written out, one pixel at a time, nothing shared with the kernels.

Only the tables (columns, filters, noise factors) come from the library.
"""

from dataclasses import replace

import numpy as np
from scipy.ndimage import correlate1d, minimum_filter

from leafflow_ti.models import AXES, ColumnSet
from leafflow_ti.sampling import Sampling, column_noise, cross_noise, noise_ratio
from leafflow_ti.stages import estimate

ARRAY_AXIS = {"t": 0, "sy": 1, "sx": 2, "y": 3, "x": 4}


def derivative(images, sampling: Sampling, channel: str):
    """One channel of ``images`` [t, sy, sx, y, x], same shape; the outermost filter radius is meaningless."""
    out = np.asarray(images, dtype=np.float64)
    for name in AXES:
        out = correlate1d(out, sampling.axis(name).kernel(name == channel), axis=ARRAY_AXIS[name], mode="nearest")
    return out


def filters_see(valid, sampling: Sampling):
    """Where every pixel under the filters is valid; [t, y, x] like ``valid``."""
    size = [2 * sampling.axis(a).filter_radius + 1 for a in ("t", "y", "x")]
    return minimum_filter(valid.astype(float), size, mode="nearest")


def structure_tensor(images, sampling: Sampling, columns: ColumnSet, pixels, valid=None):
    """J [n, N, N] by direct sums of d d^T over the window around each pixel (x, y), middle camera and frame.

    Samples whose filters see a pixel that is not ``valid`` [t, y, x] have no weight.
    """
    channels = {c: derivative(images, sampling, c) for c in columns.channels}
    centre = {a: images.shape[ARRAY_AXIS[a]] // 2 for a in ("t", "sy", "sx")}
    half = {a: sampling.axis(a).size // 2 for a in AXES}
    offsets = {a: np.arange(-half[a], half[a] + 1, dtype=float) for a in AXES}
    grids = dict(zip(ARRAY_AXIS, np.meshgrid(*(offsets[a] for a in ARRAY_AXIS), indexing="ij"), strict=True))
    weight = np.ones(next(iter(grids.values())).shape)
    for a in ARRAY_AXIS:
        shape = [1] * 5
        shape[ARRAY_AXIS[a]] = -1
        weight = weight * np.array(sampling.axis(a).weights).reshape(shape)
    seen = np.ones((len(images), *images.shape[3:])) if valid is None else filters_see(valid, sampling)
    result = []
    for x, y in pixels:
        where = {**centre, "x": x, "y": y}
        window = tuple(slice(where[a] - half[a], where[a] + half[a] + 1) for a in ARRAY_AXIS)
        d = []
        for column in columns.columns:
            d.append({})
            for term in column.terms:
                value = term.factor * channels[term.channel][window]
                for a, e in zip(AXES, term.exponents, strict=True):
                    value *= grids[a] ** e
                d[-1][term.vector] = d[-1].get(term.vector, 0.0) + value.ravel()
        counted = (weight * seen[window[0], None, None, window[3], window[4]]).ravel()
        J = np.zeros((columns.n, columns.n))
        for vector in {v for values in d for v in values}:
            one = np.array([values.get(vector, np.zeros(counted.size)) for values in d])
            J += (one * counted) @ one.T
        result.append(J)
    return np.array(result)


def shares(columns: ColumnSet):
    """Matrix [n_flow, n_flow] by which the columns come from monomials: 1, and what centring takes off."""
    flow = columns.columns[: columns.n_flow]
    T = np.eye(columns.n_flow)
    for i, column in enumerate(flow):
        for term in column.terms[1:] if max(column.terms[0].exponents) > 1 else ():
            T[i, [c.terms[0] for c in flow].index(replace(term, factor=1.0))] = term.factor
    return T


def at_centre(P, cov, columns: ColumnSet):
    """Parameters [n_flow, k] and covariances of monomials instead of centred columns: the values at the centre."""
    T = shares(columns)
    return T.T @ P, T.T @ cov @ T


def texture_smoothness(images, sampling: Sampling, x, y):
    """The factor ρ: energy of the reference camera's gradient smoothed once more in x and y, over its energy."""
    middle = [n // 2 for n in images.shape[:3]]
    h, w = sampling.y.size // 2, sampling.x.size // 2
    window = np.outer(sampling.y.weights, sampling.x.weights)
    energy = np.zeros(2)
    for channel in ("x", "y"):
        gradient = derivative(images, sampling, channel)[:, middle[1], middle[2]]
        for i, weight in enumerate(sampling.t.weights, start=middle[0] - sampling.t.size // 2):
            smooth = correlate1d(gradient[i], sampling.y.kernel(False), axis=0)
            smooth = correlate1d(smooth, sampling.x.kernel(False), axis=1)
            for k, image in enumerate((gradient[i], smooth)):
                energy[k] += weight * np.sum(window * image[y - h : y + h + 1, x - w : x + w + 1] ** 2)
    return energy[1] / energy[0]


def solutions_ols(J, columns: ColumnSet):
    """P [n_flow, k]: Eq. (2.15) for each time-like axis."""
    n = columns.n_flow
    return -np.linalg.solve(J[:n, :n], J[:n, n:])


def solutions_tls(J, columns: ColumnSet, noise=None):
    """P [n_flow, k] from the k smallest eigenvectors, combined so that one time-like differential is 1 (3.3.2)."""
    s = np.ones(columns.n) if noise is None else noise**-0.5
    _, vectors = np.linalg.eigh(J * np.outer(s, s))
    v = vectors[:, : columns.n_time_like] * s[:, None]
    n = columns.n_flow
    return v[:n] @ np.linalg.inv(v[n:])


def noise_variance(J, P, columns: ColumnSet, noise):
    """Image noise variance [k] that each solution's residual amounts to."""
    full = np.vstack([P, np.eye(columns.n_time_like)])
    return np.einsum("ik,ij,jk->k", full, J, full) / np.einsum("ik,i,ik->k", full, noise, full)


def covariances(J, variances, columns: ColumnSet, sampling: Sampling, rho=1.0, denoise=0.9):
    """Cov [k, k, n_flow, n_flow] between the parameters of each pair of solutions.

    ``denoise``: the share of the noise of its own columns, at the variance of the quietest solution, that J_ff loses.
    """
    n, k = columns.n_flow, columns.n_time_like
    noise = np.diag(column_noise(sampling, columns)[:n])
    inverse = np.linalg.inv(J[:n, :n] - denoise * np.min(variances) * noise)
    cov = np.zeros((k, k, n, n))
    for i, one in enumerate(columns.solutions):
        for j, two in enumerate(columns.solutions):
            M = np.zeros((n, n))
            if i == j:
                # The ratios are those of monomials: there, and back.
                T = shares(columns)
                R = np.linalg.inv(T)
                M = T @ (R @ J[:n, :n] @ R.T * noise_ratio(sampling, columns, one)[0]) @ T.T
            else:
                for term in cross_noise(sampling, columns, one, two):
                    M[term.a, term.b] = J[term.base_a, term.base_b] * term.value
            cov[i, j] = rho * np.sqrt(variances[i] * variances[j]) * inverse @ M @ inverse
    return cov


def fit_geometry(P, cov, columns: ColumnSet, baseline, shift, weighted=True):
    """Least-squares (nu, b_x, b_y, b_t) per mm from every camera solution, vertical disparities being zero.

    Returns names, values [m], covariance [m, m], covariance with the parameters of the motion [m, n_flow] or None.
    """
    names = [o for o in ("1", "x", "y", "t") if columns.index("x", o) is not None]
    m = len(names)
    last = columns.solutions.index("t") if "t" in columns.solutions else None
    normal, rhs, spread, cross = np.zeros((m, m)), np.zeros(m), np.zeros((m, m)), np.zeros((m, columns.n_flow))
    for k, axis in enumerate(columns.solutions):
        if axis == "t":
            continue
        own, other = ("x", "y") if axis == "sx" else ("y", "x")
        step = baseline[0 if axis == "sx" else 1]
        rows = [columns.index(own, o) for o in names] + [columns.index(other, o) for o in names]
        value = P[rows, k].copy()
        value[0] += shift[0 if axis == "sx" else 1]
        A = np.vstack([step * np.eye(m), np.zeros((m, m))])
        C = cov[k, k][np.ix_(rows, rows)]
        W = np.linalg.inv(C) if weighted else np.eye(2 * m)
        normal += A.T @ W @ A
        rhs += A.T @ W @ value
        spread += A.T @ W @ C @ W @ A
        if last is not None:
            cross += A.T @ W @ cov[k, last][rows]
    inverse = np.linalg.inv(normal)
    return names, inverse @ rhs, inverse @ spread @ inverse, inverse @ cross


def surface(x0, y0, f, nu, b1=0.0, b2=0.0):
    """Z0, ZX, ZY, c of Eq. (6.13), (6.14); x0, y0 from the principal point."""
    Z0 = -f / nu
    p, q = b1 * Z0, b2 * Z0
    c = 1 / (1 + p * x0 / f + q * y0 / f)
    return Z0, c * p, c * q, c


def motion_rows(x0, y0, f, geometry, offsets, q, shift, baseline):
    """Design [rows, 9] by (N, Ω, A) of the motion rows, linearised about the motion ``q`` for Ω × N (5.18).

    Rows run over the directions, then the offsets. The s-offsets are per camera step at the preshifted pixel.
    """
    nu, b1, b2 = geometry
    Z0, ZX, ZY, c = surface(x0, y0, f, nu, b1, b2)
    N = np.zeros(3)
    N[: min(3, len(q))] = q[:3]
    Zt = N[2] - ZX * N[0] - ZY * N[1]
    e = np.array([[1, 0, -x0 / f], [0, 1, -y0 / f]])
    delta = {
        "x": Z0 / (f * c) * np.array([1 - ZY * y0 / f, ZX * y0 / f, ZX]),
        "y": Z0 / (f * c) * np.array([ZY * x0 / f, 1 - ZX * x0 / f, ZY]),
        "sx": np.array([c + ZX * x0 / f, ZX * y0 / f, ZX]) / c,
        "sy": np.array([ZY * x0 / f, c + ZY * y0 / f, ZY]) / c,
        "t": Zt / (f * c) * np.array([x0, y0, f]) - N,
    }
    b = {
        "x": ZX / (Z0 * c),
        "y": ZY / (Z0 * c),
        "sx": f * ZX / (Z0**2 * c),
        "sy": f * ZY / (Z0**2 * c),
        "t": f * Zt / (Z0**2 * c),
    }
    unit = np.eye(3)

    def row(k, o):
        r = np.zeros(9)
        if o == "1":
            r[:3] = -nu * e[k]
            return r
        r[:3] = -b[o] * e[k]
        if (o, k) in (("x", 0), ("y", 1)):
            r[2] += nu / f
        for j in range(3):
            r[3 + j] = -nu * e[k] @ np.cross(unit[j], delta[o])
        if o == "t":
            r[6:9] = -nu * e[k]
        return r

    def measured(k, o):
        if o == "sx":
            return baseline[0] * row(k, "sx") + shift[0] * row(k, "x")
        if o == "sy":
            return baseline[1] * row(k, "sy") + shift[1] * row(k, "y")
        return row(k, o)

    return np.array([measured(k, o) for k in (0, 1) for o in offsets])


def range_row(x0, y0, f, geometry):
    """Design [9] of the range constraint for b_t (5.23)."""
    Z0, ZX, ZY, c = surface(x0, y0, f, *geometry)
    r = np.zeros(9)
    r[:3] = f / (Z0**2 * c) * np.array([-ZX, -ZY, 1.0])
    return r


def fit_motion(
    x0,
    y0,
    f,
    P,
    cov,
    columns,
    geometry,
    offsets,
    use_range,
    n,
    baseline,
    shift,
    weighted=True,
    passes=4,
    caution=1.0,
):
    """The first ``n`` of (N, Ω, A) and their covariance; ``geometry`` is what fit_geometry returned.

    The rows' covariance holds the noise of the motion parameters, of the geometry that the design is built from, and
    what both have in common. The weights leave the common part out: b_t and a_s measure the same mixed derivative with
    the same noise, and weights that knew it would stake everything on the difference of the two. ``caution`` multiplies
    the standard error of b_t in the weights.
    """
    names, g, cov_g, cross = geometry
    k = columns.solutions.index("t")
    rows = [columns.index(d, o) for d in ("x", "y") for o in offsets]
    value = P[rows, k]
    base = cov[k, k][np.ix_(rows, rows)]
    cross = cross[:, rows]
    factors = [1.0] * (2 * len(offsets)) + [caution] * use_range
    if use_range:
        it = names.index("t")
        value = np.append(value, g[it])
        base = np.pad(base, ((0, 1), (0, 1)))
        cross = np.pad(cross, ((0, 0), (0, 1)))

    def design(geometry, q):
        A = motion_rows(x0, y0, f, geometry, offsets, q, shift, baseline)
        return np.vstack([A, range_row(x0, y0, f, geometry)])[:, :n] if use_range else A[:, :n]

    q = np.zeros(n)
    surface_terms = np.zeros(3)
    surface_terms[: min(3, len(g))] = g[:3]
    for _ in range(passes):
        A = design(surface_terms, q)
        D = np.zeros((len(value), len(g)))
        for i in range(min(3, len(g))):
            step = np.zeros(3)
            step[i] = 1e-4 * abs(g[0]) * (1 if i == 0 else 1 / f)
            D[:, i] = -(design(surface_terms + step, q) - design(surface_terms - step, q)) @ q / (2 * step[i])
        if use_range:
            D[-1, it] += 1.0
        spread = base + D @ cov_g @ D.T
        total = spread + D @ cross + cross.T @ D.T
        W = np.linalg.inv(spread * np.outer(factors, factors)) if weighted else np.eye(len(value))
        G = np.linalg.solve(A.T @ W @ A, A.T @ W)
        q = G @ value
    return q, G @ total @ G.T


def solve(J, columns: ColumnSet, sampling: Sampling, estimator):
    """Parameters P [n_flow, k] of one of the estimators, and the noise variance [k] of their residuals."""
    noise = column_noise(sampling, columns)
    if estimator == "ols":
        P = solutions_ols(J, columns)
    else:
        P = solutions_tls(J, columns, noise if estimator == "tls-equilibrated" else None)
    return P, noise_variance(J, P, columns, noise)


def measure(J, rho, problem, view, x, y):
    """Every map of one pixel (x, y): name -> (value, standard error). ``problem``, ``view``: what the stages get."""
    columns, sampling = problem.columns, problem.sampling
    P, variance = solve(J, columns, sampling, problem.estimator)
    cov = covariances(J, variance, columns, sampling, rho, estimate.DENOISE[problem.estimator])
    P, cov = at_centre(P, cov, columns)
    x0, y0, f = x - view.principal_px[0], y - view.principal_px[1], view.f_px
    found = {}
    for k, axis in enumerate(columns.solutions):
        for o in ("1", "x", "y", "t") if axis == "t" else ("1",):
            i = columns.index("i", o)
            if i is not None:
                found[f"brightness_{axis}{o.strip('1')}"] = (-P[i, k], np.sqrt(cov[k, k, i, i]))
        if axis == "t":
            for a in ("x", "y"):
                i = columns.index(a)
                found[f"flow_{a}"] = (P[i, k], np.sqrt(cov[k, k, i, i]))
    if not problem.camera_axes:
        return found
    geometry = fit_geometry(P, cov, columns, view.baseline_mm, view.shift_px, problem.weighted)
    g, cov_g = geometry[1][:3], geometry[2][:3, :3]
    step = view.baseline_mm[0 if problem.camera_axes[0] == "sx" else 1]

    def put(name, value):
        """A function of the geometry, its error by central differences."""
        gradient = np.zeros(len(g))
        for i in range(len(g)):
            d = np.zeros(len(g))
            d[i] = 1e-5 * abs(g[0]) * (1 if i == 0 else 1 / f)
            gradient[i] = (value(g + d) - value(g - d)) / (2 * d[i])
        found[name] = (value(g), np.sqrt(gradient @ cov_g @ gradient))

    put("disparity", lambda g: g[0] * step)
    put("depth", lambda g: surface(x0, y0, f, *g)[0])
    if len(g) > 1:
        put("slope_x", lambda g: surface(x0, y0, f, *g)[1])
        put("slope_y", lambda g: surface(x0, y0, f, *g)[2])
    if problem.unknowns:
        q, cov_q = fit_motion(
            x0, y0, f, P, cov, columns, geometry, problem.offsets, problem.use_range, problem.unknowns,
            view.baseline_mm, view.shift_px, problem.weighted, problem.passes,
            estimate.RANGE_CAUTION,
        )  # fmt: skip
        names = [f"{quantity}_{a}" for quantity in ("velocity", "rotation", "acceleration") for a in "xyz"]
        for name, value, error in zip(names[: problem.unknowns], q, np.sqrt(np.diag(cov_q)), strict=True):
            found[name] = (value, error)
    if problem.world_brightness:
        i = [columns.index("i", o) for o in problem.world_brightness]
        Z0, ZX, ZY, c = surface(x0, y0, f, *g)
        dX = Z0 / (f * c) * np.array([[1 - ZY * y0 / f, ZX * y0 / f], [ZY * x0 / f, 1 - ZX * x0 / f]])
        A = np.zeros((len(i), len(i)))
        A[:2, :2] = np.linalg.inv(dX)
        if len(i) == 3:
            Zt = q[2] - ZX * q[0] - ZY * q[1]
            drift = Zt / (f * c) * np.array([x0, y0]) - q[:2]
            A[2] = [*(-drift @ A[:2, :2]), 1.0]
        values, spread = A @ -P[i, -1], A @ cov[-1, -1][np.ix_(i, i)] @ A.T
        for name, value, variance in zip(("x", "y", "tt"), values, np.diag(spread), strict=False):
            found[f"brightness_world_{name}"] = (value, np.sqrt(variance))
    return found
