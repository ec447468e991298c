"""Naive float64 twin of what follows the flow parameters: geometry, the fit of the motion, every map of a pixel."""

import numpy as np
from reference.chain import unsheared

from leafflow_ti.kernels.patch_fit import HELD
from leafflow_ti.models import AXES, ColumnSet
from leafflow_ti.sampling import difference_variance
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.thresholds import DENOISE, MAX_CONTRADICTION, MODEL_ERROR, TURNING_ERROR


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


def motion_rows(x0, y0, f, geometry, offsets, q, shift, baseline, curved=None, centroid=(0.0, 0.0)):
    """Design [rows, 10] by (N, Ω, A, ε) of the motion rows, linearised about the motion ``q`` for Ω × N (5.18).

    Rows run over the directions, then the offsets. The s-offsets are per camera step at the preshifted pixel.
    ``curved`` [3, 3]: projections of x², xy, y² (columns) on 1, x, y over the window, by which these rows see the
    flow's second-order part. ``centroid`` (x, y): of what the window sees, from the pixel; derivatives along s and t
    are those there.
    """
    if np.any(centroid):
        x, y, plane, there, P = moved(x0, y0, f, geometry, q, centroid)
        here = motion_rows(x0, y0, f, geometry, offsets, q, shift, baseline, curved)
        away = about_point(motion_rows(x, y, f, plane, offsets, there, shift, baseline), P)
        far = np.array([o in ("sx", "sy", "t") for _ in (0, 1) for o in offsets])
        return np.where(far[:, None], away, here)
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

    def row(k, o):
        r = np.zeros(10)
        if o == "1":
            r[:3] = -nu * e[k]
            return r
        r[:3] = -b[o] * e[k]
        if (o, k) in (("x", 0), ("y", 1)):
            r[2] += nu / f
        r[3:6] = -nu * cross(delta[o], e[k])
        r[9] = -nu * e[k] @ delta[o]
        if o == "t":
            r[6:9] = -nu * e[k]
        return r

    def projected(k, o):
        # Along s nothing is bent: what is seen there is the derivative of the flow alone.
        found = np.zeros(10)
        for column, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            share = curved["1xy".index(o), column] * (0.5 if i == j else 1.0)
            if share:
                found += share * second_derivative(x0, y0, f, (Z0, ZX, ZY), k, i, j)
        return found

    def measured(k, o):
        if o == "sx":
            return baseline[0] * row(k, "sx") + shift[0] * row(k, "x")
        if o == "sy":
            return baseline[1] * row(k, "sy") + shift[1] * row(k, "y")
        return row(k, o) if curved is None or o == "t" else row(k, o) + projected(k, o)

    return np.array([measured(k, o) for k in (0, 1) for o in offsets])


def second_derivative(x0, y0, f, plane, k, i, j):
    """Coefficients [10] of (N, Ω, A, ε) of ∂²u_k/∂x_i∂x_j on the plane (Z0, ZX, ZY) at (x0, y0), by exact differences.

    The flow of a rigidly moving plane is quadratic in x and y, so second differences of any width are exact.
    """
    Z0, ZX, ZY = plane
    X0 = Z0 * np.array([x0 / f, y0 / f, 1.0])

    def flow(d):
        """Of each component of the motion alone."""
        ray = np.array([(x0 + d[0]) / f, (y0 + d[1]) / f, 1.0])
        X = (Z0 - ZX * X0[0] - ZY * X0[1]) / (1 - ZX * ray[0] - ZY * ray[1]) * ray
        along = np.array([float(k == 0), float(k == 1), -ray[k]])
        seen = np.zeros(10)
        seen[:3], seen[3:6], seen[9] = along, cross(X - X0, along), along @ (X - X0)
        return f * seen / X[2]

    h = 0.05 * f
    one, two = h * np.eye(2)[i], h * np.eye(2)[j]
    return sum(s * t * flow(s * one + t * two) for s in (1, -1) for t in (1, -1)) / (4 * h**2)


def cross(u, v):
    """The cross product; many times as fast as NumPy's for one pair."""
    return np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])


def moved(x0, y0, f, geometry, q, by):
    """Pixel, geometry and motion where the patch is seen ``by`` (x, y) px further; P from its point to there."""
    nu, b1, b2 = geometry
    x, y = x0 + by[0], y0 + by[1]
    there = (nu + b1 * by[0] + b2 * by[1], b1, b2)
    P = -f / there[0] * np.array([x / f, y / f, 1.0]) + f / nu * np.array([x0 / f, y0 / f, 1.0])
    motion = np.array(q, float)
    motion[:3] += np.cross(q[3:6], P) + q[9] * P
    return x, y, there, motion, P


def about_point(rows, P):
    """Design [rows, 10] by the motion of the patch from that by the motion of its part at P."""
    rows = rows.copy()
    rows[:, 3:6] += np.cross(P, rows[:, :3])
    rows[:, 9] += rows[:, :3] @ P
    return rows


def range_row(x0, y0, f, geometry, centroid=(0.0, 0.0)):
    """Design [10] of the range constraint for b_t (5.23), which is that at the centroid of what is seen."""
    if np.any(centroid):
        x, y, there, _, P = moved(x0, y0, f, geometry, np.zeros(10), centroid)
        row = about_point(range_row(x, y, f, there)[None], P)[0]
        row[9] = 0.0  # growth moves points within the plane
        return row
    Z0, ZX, ZY, c = surface(x0, y0, f, *geometry)
    r = np.zeros(10)
    r[:3] = f / (Z0**2 * c) * np.array([-ZX, -ZY, 1.0])
    return r


def seen_of(solved, sampling):
    """``curved`` and ``centroid`` of ``motion_rows`` for a solution; of a whole window its second moments."""
    if solved.curved is not None:
        return solved.curved, solved.centroid
    whole = np.zeros((3, 3))
    whole[0, 0], whole[0, 2] = sampling.x.moment(2), sampling.y.moment(2)
    return whole, solved.centroid


def shared_covariance(found_own, P_inverse, own_inverse, columns, own_columns, sampling, own_sampling, step):
    """Covariance [n_flow, n_flow of the own flow], per σ² ρ, of the motion parameters of grid and camera.

    The grid's normal equations hold the image of the camera at ``step`` with the weights of window and smoothing.
    """
    n, m = columns.n_flow, own_columns.n_flow
    noise = found_own.solution_noise(own_columns, own_sampling, "t")
    X = np.zeros((n, m))
    for a, column in enumerate(columns.columns[:n]):
        factor = 1.0
        exponents = dict(zip(AXES, column.terms[0].exponents, strict=True))
        for axis, k in zip(("sx", "sy"), step, strict=True):
            one = sampling.axis(axis)
            half, radius = one.size // 2, one.filter_radius
            factor *= sum(
                one.weights[i + half] * one.offsets[i + half] ** exponents[axis] * one.kernel(False, i)[k - i + radius]
                for i in range(-half, half + 1)
                if abs(k - i) <= radius
            )
        kept = tuple(0 if axis in ("sx", "sy") else e for axis, e in exponents.items())
        partner = [
            b for b, c in enumerate(own_columns.columns[:m])
            if (c.channel, c.terms[0].exponents) == (column.channel, kept)
        ]  # fmt: skip
        if partner:
            X[a] = factor * noise[partner[0]]
    return P_inverse @ X @ own_inverse


def fit_motion(x0, y0, solved, P, cov, geometry, problem, view, own=()):
    """The motion, three covariances, and the motion (N, Ω, A) from the reference's rows alone.

    The covariances are those of the unknowns, and of their central differences along x and y; in a difference, a row is
    left with less of its error: a row with an offset along that axis is a first moment of its window, all others means.

    ``geometry`` is what fit_geometry returned.

    ``P``, ``cov``: of ``solved``, at the centre. ``own``: the solution of every camera's own flow, in the order of
    ``problem.own_flows.steps``. First comes a fit to the rows of the reference model; with own flows, one more to all
    rows, linearised there. The rows' covariance holds the noise of the motion parameters, of the geometry that the
    design is built from, what both have in common and what cameras have in common with the reference model. The weights
    leave out what is common to sets of rows, and to geometry and motion.
    """
    columns, sampling, f = problem.columns, problem.sampling, view.f_px
    shift, baseline = view.shift_px, view.baseline_mm
    names, g, cov_g, cross_g = geometry
    surface_terms = np.zeros(3)
    surface_terms[: min(3, len(g))] = g[:3]
    k = columns.solutions.index("t")
    it = names.index("t") if "t" in names else None
    denoise = DENOISE[problem.estimator]
    inverse = np.linalg.inv(solved.clean(denoise))

    def rows_of(value, C, shared, design, codes, has_range, q):
        """Design, values, own covariance, sensitivity, covariance with the geometry, what the equations leave out."""
        A = design(surface_terms, q)
        D = np.zeros((len(value), len(g)))
        for i in range(min(3, len(g))):
            step = np.zeros(3)
            step[i] = 1e-4 * abs(g[0]) * (1 if i == 0 else 1 / f)
            D[:, i] = -(design(surface_terms + step, q) - design(surface_terms - step, q)) @ q / (2 * step[i])
        if has_range:
            D[-1, it] += 1.0
        floor = np.array([MODEL_ERROR[code] for code in codes]) * (np.abs(A) @ np.abs(q))
        Z0, ZX, ZY, _ = surface(x0, y0, f, *surface_terms)
        turning = f / Z0 * np.linalg.norm(q[3:6]) * np.sqrt(1 + ZX**2 + ZY**2)
        for i, code in enumerate(codes):
            if code in ("sx", "sy", "range"):
                steps = {"sx": abs(baseline[0]), "sy": abs(baseline[1]), "range": 1.0}[code]
                floor[i] += TURNING_ERROR * turning * steps
        return A, value, C, D, shared, np.diag(floor**2), codes

    def reference_rows(q):
        rows = [columns.index(d, o) for d in ("x", "y") for o in problem.offsets]
        value, C, shared = P[rows, k], cov[k, k][np.ix_(rows, rows)], cross_g[:, rows]
        codes = [*problem.offsets, *problem.offsets]
        if problem.use_range:
            value, C = np.append(value, g[it]), np.pad(C, ((0, 1), (0, 1)))
            shared = np.pad(shared, ((0, 0), (0, 1)))
            codes.append("range")

        def design(geometry, q):
            A = motion_rows(x0, y0, f, geometry, problem.offsets, q, shift, baseline, *seen_of(solved, sampling))
            return np.vstack([A, range_row(x0, y0, f, geometry, solved.centroid)]) if problem.use_range else A

        return rows_of(value, C, shared, design, codes, problem.use_range, q), rows

    def own_rows(step, place, found_own, q):
        flows = problem.own_flows
        s2 = found_own.variance
        p, C = found_own.at_centre(flows.columns, flows.sampling, denoise, view.motion_px)
        C = C[0, 0]
        rows = [flows.columns.index(d, o) for d in ("x", "y") for o in flows.offsets]
        E = np.eye(flows.columns.n_flow)[rows]
        moved = np.array([place[i] * (g[0] * baseline[i] - shift[i]) for i in (0, 1)])
        for r, (d, o) in enumerate((d, o) for d in ("x", "y") for o in flows.offsets):
            if o == "1":
                for axis, distance in zip(("x", "y"), moved, strict=True):
                    E[r, flows.columns.index(d, axis)] += distance
        x, y = (at + g[0] * baseline[i] * place[i] for i, at in enumerate((x0, y0)))

        def design(geometry, q):
            Z0, ZX, ZY, _ = surface(x0, y0, f, *geometry)
            c = 1 - ZX * x / f - ZY * y / f
            there = (-f / Z0, ZX / (Z0 * c), ZY / (Z0 * c))
            curved, centroid = seen_of(found_own, sampling)
            curved = np.vstack([curved[0] + moved @ curved[1:], curved[1:]])
            return motion_rows(x, y, f, there, flows.offsets, q, shift, baseline, curved, centroid)

        codes = [*flows.offsets, *flows.offsets]
        found = rows_of(E @ p[:, 0], E @ C @ E.T, np.zeros((len(g), len(rows))), design, codes, False, q)
        own_inverse = np.linalg.inv(found_own.clean(denoise))
        shared = shared_covariance(
            found_own, inverse, own_inverse, columns, flows.columns, sampling, flows.sampling, step
        ) * (found_own.rho * np.sqrt(solved.variance[k] * s2[0]))
        shared = unsheared(columns, view.motion_px) @ shared @ unsheared(flows.columns, view.motion_px).T
        return found, shared @ E.T

    def fit(sets, which, common):
        """Components ``which`` of (N, Ω, A, ε), covariances; ``common``: of the first set's rows with each other's."""
        weights = []
        for _, _, C, D, _, left_out, _ in sets:
            weights.append(np.linalg.inv(C + D @ cov_g @ D.T + left_out) if problem.weighted else np.eye(len(C)))
        normal = sum(A[:, which].T @ W @ A[:, which] for (A, *_), W in zip(sets, weights, strict=True))
        if chosen and 9 in which:
            normal[-1, -1] *= HELD  # growth
        gains = [np.linalg.solve(normal, A[:, which].T @ W) for (A, *_), W in zip(sets, weights, strict=True)]
        solution = sum(G @ s[1] for G, s in zip(gains, sets, strict=True))
        spreads = [spread_of(gains, sets, common)]
        for axis in ("x", "y"):
            scaled = []
            for G, s in zip(gains, sets, strict=True):
                left = [difference_variance(sampling.axis(axis), 2 * view.step, int(code == axis)) for code in s[6]]
                scaled.append(G * np.sqrt(left))
            spreads.append(spread_of(scaled, sets, common))
        return solution, spreads

    def spread_of(gains, sets, common):
        by_geometry = sum(G @ s[3] for G, s in zip(gains, sets, strict=True))
        spread = sum(G @ s[2] @ G.T for G, s in zip(gains, sets, strict=True)) + by_geometry @ cov_g @ by_geometry.T
        for G, s in zip(gains, sets, strict=True):
            part = by_geometry @ s[4] @ G.T
            spread += part + part.T
        for G, C in zip(gains[1:], common, strict=True):
            part = gains[0] @ C @ G.T
            spread += part + part.T
        return spread

    flows = problem.own_flows
    # A robust estimate had to choose what of the reference's window belongs to the pixel.
    chosen = flows and flows.reference_rows and ESTIMATORS[problem.estimator].robust and solved.support < 1
    q = np.zeros(10)
    for _ in range(problem.passes):
        first, rows = reference_rows(q)
        q[: problem.fitted], spreads = fit([first], list(range(problem.fitted)), [])
    if problem.own_flows is None:
        return q[: problem.fitted], spreads, q
    first, rows = reference_rows(q)
    sets, common = ([first], []) if problem.own_flows.reference_rows else ([], [])
    flows = problem.own_flows
    for step, place, one in zip(flows.steps, flows.places or flows.steps, own, strict=True):
        found, shared = own_rows(step, place, one, q)
        if chosen:
            # In this camera it may have chosen another surface.
            A, value, C, D, _, left_out, _ = found
            own_errors = np.diag(C + D @ cov_g @ D.T + left_out)
            if np.mean((value - A @ q) ** 2 / own_errors) > MAX_CONTRADICTION:
                continue
        if problem.own_flows.reference_rows:
            common.append(np.pad(shared[rows], ((0, problem.use_range), (0, 0))))
        elif sets:
            common.append(np.zeros((len(sets[0][1]), len(found[1]))))
        sets.append(found)
    which = [*range(problem.own_flows.unknowns), *([9] if problem.own_flows.growth else [])]
    return *fit(sets, which, common), q


def measure(solved, problem, view, x, y, own=()):
    """Every map of one pixel (x, y): name -> (value, standard error). ``problem``, ``view``: what the stages get.

    ``solved``, ``own``: the solution of the reference model, those of every camera's own flow (``chain.Solved``).
    """
    columns, sampling = problem.columns, problem.sampling
    P, cov = solved.at_centre(columns, sampling, DENOISE[problem.estimator], view.motion_px)
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
        return {**found, **flow_gradient(P[:, 0], cov[0, 0], columns)}
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
        q, (cov_q, *_), alone = fit_motion(x0, y0, solved, P, cov, geometry, problem, view, own)
        names = [f"{quantity}_{a}" for quantity in ("velocity", "rotation", "acceleration") for a in "xyz"]
        for name, value, error in zip(names[: problem.unknowns], q, np.sqrt(np.diag(cov_q)), strict=False):
            found[name] = (value, error)
    if problem.world_brightness:
        i = [columns.index("i", o) for o in problem.world_brightness]
        Z0, ZX, ZY, c = surface(x0, y0, f, *g)
        dX = Z0 / (f * c) * np.array([[1 - ZY * y0 / f, ZX * y0 / f], [ZY * x0 / f, 1 - ZX * x0 / f]])
        A = np.zeros((len(i), len(i)))
        A[:2, :2] = np.linalg.inv(dX)
        if len(i) == 3:
            Zt = alone[2] - ZX * alone[0] - ZY * alone[1]
            drift = Zt / (f * c) * np.array([x0, y0]) - alone[:2]
            A[2] = [*(-drift @ A[:2, :2]), 1.0]
        values, spread = A @ -P[i, -1], A @ cov[-1, -1][np.ix_(i, i)] @ A.T
        for name, value, variance in zip(("x", "y", "tt"), values, np.diag(spread), strict=False):
            found[f"brightness_world_{name}"] = (value, np.sqrt(variance))
    return found


def flow_gradient(p, cov, columns: ColumnSet):
    """Derivatives of one camera's flow from its parameters p [n_flow], and their symmetric part in per cent."""
    columns_of = {c + o: columns.index(c, o) for c in ("x", "y") for o in ("x", "y")}
    if None in columns_of.values():
        return {}
    unit = {name: np.eye(len(p))[i] for name, i in columns_of.items()}
    weights = {f"flow_{name}": e for name, e in unit.items()}
    weights |= {f"strain_{a}{b}": 50 * (unit[a + b] + unit[b + a]) for a, b in ("xx", "yy", "xy")}
    return {name: (w @ p, np.sqrt(w @ cov @ w)) for name, w in weights.items()}


def motion_spreads(solved, problem, view, x, y, own=()):
    """Covariances of the motion, and of its central differences along x and y."""
    columns, sampling = problem.columns, problem.sampling
    P, cov = solved.P, solved.covariances(columns, sampling, DENOISE[problem.estimator])
    geometry = fit_geometry(P, cov, columns, view.baseline_mm, view.shift_px, problem.weighted)
    x0, y0 = x - view.principal_px[0], y - view.principal_px[1]
    return fit_motion(x0, y0, solved, P, cov, geometry, problem, view, own)[1]


def velocity_correlations(solved, problem, view, x, y, own=()):
    """Correlations of the errors of the velocity's components."""
    C = motion_spreads(solved, problem, view, x, y, own)[0]
    pairs = [pair for pair in ((0, 1), (0, 2), (1, 2)) if max(pair) < problem.unknowns]
    return {f"velocity_correlation_{'xyz'[i]}{'xyz'[j]}": C[i, j] / np.sqrt(C[i, i] * C[j, j]) for i, j in pairs}


def velocity_differences(solved, problem, view, x, y, own=()):
    """Covariances of the velocity's central differences: name -> (value, geometric mean of its variances)."""
    _, *spreads = motion_spreads(solved, problem, view, x, y, own)
    found = {}
    for axis, C in zip(("x", "y"), spreads, strict=True):
        for a, b in ("xx", "xy", "yy", "xz", "yz", "zz"):
            i, j = "xyz".index(a), "xyz".index(b)
            found[f"difference_{axis}_{a}{b}"] = (C[i, j], np.sqrt(C[i, i] * C[j, j]))
    return found
