"""What the per-pixel stages share: the workspace of a group of pixels, and the tables that describe a model to them.

A stage works in regions of one flat workspace (see ``dense``) and reads what it needs to know from two tables:
``number`` (int32: region offsets, sizes, lists of rows) and ``value`` (scales, noise factors, camera). One compilation
of a stage serves every model.
"""

from dataclasses import dataclass
from enum import IntEnum, auto

import numpy as np

BLOCK = 4
"""Most vectors that the block inverse iteration carries: the solutions and at least one guard."""
MAX_UNKNOWNS = 10
"""Components (N, Ω, A, ε) of the motion."""
PATCH_SIZE = 12
MAX_ROWS = 16
MAX_COLUMNS = 32
MAX_CENTRE_TERMS = 14


class Region(IntEnum):
    """Regions; shapes with N columns, k solutions, F = N - k, S and T rows of a camera solution
    and of the motion solution, G geometry terms, M equations and Q unknowns of the motion fit."""

    MOMENTS = 0  # [entries + extras]: the tensor's distinct entries, window mass, energies
    TENSOR = auto()  # packed [N]: scaled structure tensor, then its Cholesky factor
    MATRIX = auto()  # packed [N]: what was factored
    VECTORS = auto()  # [N, BLOCK]: iterated vectors
    IMAGES = auto()  # [N, BLOCK]: factor times vectors
    RITZ = auto()  # [BLOCK, BLOCK]
    RITZ_VECTORS = auto()  # [BLOCK, BLOCK]
    RITZ_WORK = auto()  # [BLOCK]
    FULL = auto()  # [N, N]: for the full Jacobi
    FULL_VECTORS = auto()  # [N, N]
    SOLUTION = auto()  # [N, k]: null space, where CONVERGED
    CONVERGED = auto()  # [1]
    PARAMETERS = auto()  # [k, F]
    VARIANCE = auto()  # [k]: image noise variance of each residual
    CLEAN = auto()  # packed [F]: J_ff without the noise of the gradients, then its factor
    FLOOR = auto()  # [1]: least pivot of that factor
    NOISE = auto()  # packed [F]: noise of the normal equations
    RESPONSE_S = auto()  # [F, S]: inverse of J_ff for the geometry rows
    RESPONSE_T = auto()  # [F, T]: for the motion rows
    PRODUCT = auto()  # [F, max(S, T)]
    COV_S = auto()  # packed [S]: covariance of the geometry rows of one camera solution
    COV_T = auto()  # packed [T]: covariance of the motion rows
    CROSS = auto()  # [S, T]: geometry rows × motion rows
    BRIGHTNESS_VARIANCE = auto()  # [k]
    GEOMETRY = auto()  # [G]
    GEOMETRY_NORMAL = auto()  # packed [G]
    GEOMETRY_RHS = auto()  # [G]
    GEOMETRY_SPREAD = auto()  # packed [G]
    GEOMETRY_COV = auto()  # [G, G]
    GEOMETRY_CROSS = auto()  # [G, T]
    GEOMETRY_WORK = auto()  # [S, G]
    MOTION = auto()  # [MAX_UNKNOWNS]: by component, 0 where it is no unknown
    MOTION_COV = auto()  # [Q, Q]
    DIFFERENCE_COV = auto()  # [2, Q, Q]: of difference quotients of the motion along x and y
    PATCH = auto()  # [PATCH_SIZE]: rays and surface of the patch (kernels.patch)
    ROW = auto()  # [MAX_UNKNOWNS]: one equation's coefficients of all components
    DESIGN = auto()  # [M, Q]
    VALUE = auto()  # [M]
    LEFT_OUT = auto()  # [M]: standard size of what each equation leaves out
    WEIGHTED = auto()  # [M, Q]: weights times design
    OWN = auto()  # packed [M]: covariance of the rows without what they owe to the geometry
    FACTOR = auto()  # packed [M]: of the weights' inverse
    DERIVATIVE = auto()  # [M, G]
    MOTION_WORK = auto()  # [M, Q], packed [Q]
    NORMAL = auto()  # [Q, Q]; from here on: sums over the sets of rows of the motion fit
    NORMAL_RHS = auto()  # [Q]
    NORMAL_SPREAD = auto()  # [3, Q, Q]: for the motion and its difference quotients along x and y, as the next two
    LEFT = auto()  # [3, G + F, Q]: by the errors of the geometry, of the reference's normal equations
    RIGHT = auto()  # [3, G + F, Q]: what is correlated with them
    REFERENCE_VARIANCE = auto()  # [1]
    BIAS = auto()  # [k, F]: of the scaled normal equations, by the noise of their columns; empty without one
    ACTIVE = auto()  # [1]: 1 where a solution is wanted: once there is one, where the window is cut or weighted anew
    CUT = auto()  # [1]: 1 where the window is cut; WEIGHT_NOISE then takes the place of C
    WEIGHT_NOISE = auto()  # packed [N]: Σ w ω C, as the tensor now is; of the fundamental scheme what it takes off
    NOISE_FACTOR = auto()  # packed [N]: its factor, scaled; these two empty unless windows are cut or weighted anew
    SPREAD = auto()  # [1]: what mask or weights make of the variance of the normal equations' noise
    MASK = auto()  # [planes]: moments of the valid part of the window; these and the next seven empty unless cut
    CUT_PRODUCTS = auto()  # packed [shapes]: the shapes' products over the window, then their factor
    CUT_SQUARED = auto()  # packed [shapes]: the same with the squared weights
    CUT_SHAPE = auto()  # [shapes, shapes]: what leads from the former to the latter
    CURVED = auto()  # [3, 3]: x², xy, y² projected on 1, x, y
    CURVED_FACTOR = auto()  # packed [3]
    CENTROID = auto()  # [2]: of what is seen, px from the pixel; 0 where the window is whole
    CUT_PATCH = auto()  # [11]: patch and velocity at the pixel while rows are made for the centroid (kernels.cut_rows)
    SHARE = auto()  # [1]: mean weight; from here on: empty unless windows are weighted anew
    SCALE_SQUARED = auto()  # [1]: σ² of the penalty
    LEAST_SQUARED = auto()  # [1]: the least that it may become
    QUADRATIC = auto()  # [entries]: the mean squared residual as a function of the tensor's entries
    RELATIVE = auto()  # [monomials]: the mean relative noise as a function of the offset
    WEIGHT_SUMS = auto()  # [entries, then 2 x monomials]: of weighted cells; of their offsets' monomials
    CELL = auto()  # [sources]: block sums of one cell
    CELL_ENTRIES = auto()  # [entries]: the cell's own tensor
    DIAGONAL = auto()  # [N]: of the scaled tensor before any weights
    OUT = auto()  # [n_maps]: what the maps get


@dataclass(frozen=True)
class Layout:
    """Offsets of the regions, in elements, for a model with ``n`` columns and ``k`` solutions.

    ``moments``: planes of the largest tensor. ``rows_t`` and ``motion``: the largest numbers of motion rows and of
    equations of any camera. ``unknowns`` of the motion fit; ``correlated``: columns whose noise cameras share;
    ``maps``: output planes; ``sources``, ``monomials``: of the largest cell where windows are weighted anew, else 0;
    ``biased``: solutions are, by the noise of all columns but the time-like ones; ``mask``, ``shapes``: moments of cut
    windows and shapes of columns, 0 where none is cut.
    """

    n: int
    k: int
    moments: int
    rows_s: int
    rows_t: int
    terms: int
    motion: int
    unknowns: int
    correlated: int
    maps: int
    sources: int = 0
    monomials: int = 0
    biased: bool = False
    mask: int = 0
    shapes: int = 0

    @property
    def sizes(self) -> dict[Region, int]:
        """Number of elements of each region."""
        n, k, terms, motion, q = self.n, self.k, self.terms, self.motion, self.unknowns
        s, t, errors = self.rows_s, self.rows_t, self.terms + self.correlated
        flow = n - k
        anew, cut = int(self.sources > 0), int(self.mask > 0)
        own = max(anew, cut)

        def packed(m: int) -> int:
            return m * (m + 1) // 2

        return {
            Region.MOMENTS: self.moments,
            Region.TENSOR: packed(n),
            Region.MATRIX: packed(n),
            Region.VECTORS: n * BLOCK,
            Region.IMAGES: n * BLOCK,
            Region.RITZ: BLOCK * BLOCK,
            Region.RITZ_VECTORS: BLOCK * BLOCK,
            Region.RITZ_WORK: BLOCK,
            Region.FULL: n * n,
            Region.FULL_VECTORS: n * n,
            Region.SOLUTION: n * k,
            Region.CONVERGED: 1,
            Region.PARAMETERS: k * flow,
            Region.VARIANCE: k,
            Region.CLEAN: packed(flow),
            Region.FLOOR: 1,
            Region.NOISE: packed(flow),
            Region.RESPONSE_S: flow * s,
            Region.RESPONSE_T: flow * t,
            Region.PRODUCT: flow * max(s, t),
            Region.COV_S: packed(s),
            Region.COV_T: packed(t),
            Region.CROSS: s * t,
            Region.BRIGHTNESS_VARIANCE: k,
            Region.GEOMETRY: terms,
            Region.GEOMETRY_NORMAL: packed(terms),
            Region.GEOMETRY_RHS: terms,
            Region.GEOMETRY_SPREAD: packed(terms),
            Region.GEOMETRY_COV: terms * terms,
            Region.GEOMETRY_CROSS: terms * t,
            Region.GEOMETRY_WORK: s * terms,
            Region.MOTION: MAX_UNKNOWNS,
            Region.MOTION_COV: q * q,
            Region.DIFFERENCE_COV: 2 * q * q,
            Region.PATCH: PATCH_SIZE,
            Region.ROW: MAX_UNKNOWNS,
            Region.DESIGN: motion * q,
            Region.VALUE: motion,
            Region.LEFT_OUT: motion,
            Region.WEIGHTED: motion * q,
            Region.OWN: packed(motion),
            Region.FACTOR: packed(motion),
            Region.DERIVATIVE: motion * terms,
            Region.MOTION_WORK: max(motion * max(q, terms), packed(q)),
            Region.NORMAL: q * q,
            Region.NORMAL_RHS: q,
            Region.NORMAL_SPREAD: 3 * q * q,
            Region.LEFT: 3 * errors * q,
            Region.RIGHT: 3 * errors * q,
            Region.REFERENCE_VARIANCE: 1,
            Region.BIAS: k * flow * int(self.biased),
            Region.ACTIVE: 1,
            Region.CUT: cut,
            Region.WEIGHT_NOISE: own * packed(n),
            Region.NOISE_FACTOR: own * packed(n),
            Region.SPREAD: own,
            Region.MASK: self.mask,
            Region.CUT_PRODUCTS: packed(self.shapes),
            Region.CUT_SQUARED: packed(self.shapes),
            Region.CUT_SHAPE: self.shapes**2,
            Region.CURVED: 9 * cut,
            Region.CURVED_FACTOR: 6 * cut,
            Region.CENTROID: 2 * cut,
            Region.CUT_PATCH: 11 * cut,
            Region.SHARE: anew,
            Region.SCALE_SQUARED: anew,
            Region.LEAST_SQUARED: anew,
            Region.QUADRATIC: anew * self.moments,
            Region.RELATIVE: self.monomials,
            Region.WEIGHT_SUMS: anew * self.moments + 2 * self.monomials,
            Region.CELL: self.sources,
            Region.CELL_ENTRIES: anew * self.moments,
            Region.DIAGONAL: anew * n,
            Region.OUT: self.maps,
        }

    @property
    def offsets(self) -> np.ndarray:
        """First element of each region, int32 [len(Region)]."""
        sizes = self.sizes
        return np.cumsum([0, *(sizes[r] for r in Region)])[:-1].astype(np.int32)

    @property
    def n_elements(self) -> int:
        """Elements per pixel."""
        return sum(self.sizes.values())


class Number(IntEnum):
    """Positions in the table ``number``, behind the offsets of the regions; lists occupy several places."""

    N = len(Region)  # columns
    SOLUTIONS = auto()  # k
    FLOW = auto()  # F = N - k
    FIRST_PLANE = auto()  # where the tensor begins among the planes of all tensors
    BLOCK = auto()  # vectors of the block inverse iteration
    ITERATIONS = auto()  # of the block inverse iteration, per round
    MOTION_SOLUTION = auto()  # index of the solution along t, or -1
    TERMS = auto()  # G: geometry terms (1, x, y, t), 0 without a grid
    OFFSETS = auto()  # number of motion offsets
    ROWS_S = auto()  # rows of a camera solution: 2 G, and one for brightness if the model has it
    ROWS_T = auto()  # rows of the motion solution: MOTION_FLOW + BRIGHTNESS_ROWS
    MOTION_FLOW = auto()  # its flow rows: 2 OFFSETS; of range flow 3
    USE_RANGE = auto()
    UNKNOWNS = auto()  # of the motion fit; 0 without one
    WEIGHTED = auto()  # weighted least squares, else plain
    OWN_FLOW = auto()  # the tables of one camera's own flow, not of the reference model
    CORRELATED = auto()  # columns of the reference model whose noise other cameras share; 0 without them
    BRIGHTNESS_COLUMN = auto()  # column of I, or -1
    BRIGHTNESS_ROWS = auto()  # brightness rows of the motion solution, behind its flow rows
    WORLD_MAPS = auto()  # brightness in world coordinates: 2 along X, Y; 3 with the trend; 0 without slopes
    CENTRE_TERMS = auto()  # what other parameters add to some: see ``identify.at_centre``
    NOISE_TERMS = auto()  # terms of each solution's noise beyond the ratios
    CROSS_TERMS = auto()  # per pair (camera solution, motion)
    RANGE_TERM = auto()  # index of t among the geometry terms
    CAMERA_SOLUTIONS = auto()  # number of solutions along camera axes
    OUT_X = auto()  # pixel coordinates of the output grid: x = OUT_X + STEP column
    OUT_Y = auto()
    STEP = auto()
    PITCH = auto()
    BIASED = auto()  # what the noise of the columns does to solutions counts among their errors
    MASK_PLANES = auto()  # moments of the valid part of windows; 0: none is cut, and the next seven mean nothing
    MASK_PLANE = auto()  # where they begin among the planes
    CURVED_BASIS = auto()  # 3: the flow's second-order part is projected on 1, x, y; 1: on 1
    SHAPES = auto()  # of columns by their offsets in x and y
    CUT_NOISES = auto()  # terms of the noise's covariance
    CUT_PRODUCTS = auto()  # terms of the shapes' products
    CUT_LISTS = auto()  # where the lists of ``stages.mask_moments`` begin behind this table's first entry
    CUT_VALUES = auto()  # likewise in the table of values
    REWEIGHTED = auto()  # windows are weighted anew; what begins with CELL or SOURCE means something only then
    ROBUST = auto()  # rows of own flows that contradict the reference's are left out
    EVERYWHERE = auto()  # in every pixel, else where the plain fit failed
    PENALTY = auto()  # a Penalty
    CELLS_X = auto()  # cells of the window along x, y
    CELLS_Y = auto()
    CELL_STEP_X = auto()  # cells from one output pixel to the next
    CELL_STEP_Y = auto()
    SOURCES = auto()  # block sums of a cell
    SOURCES_AT = auto()  # where their planes begin among the tensors
    SOURCE_PLANE = auto()  # distance of the planes
    SOURCE_PITCH = auto()
    MASS_SOURCE = auto()  # which of them counts valid pixels
    CELL_MONOMIALS = auto()  # of the noise's covariance
    CELL_NOISES = auto()  # its terms
    CELL_TERMS = auto()  # terms of all entries
    CELL_LISTS = auto()  # where the lists of ``stages.cells`` begin behind this table's first entry
    CELL_VALUES = auto()  # likewise in the table of values
    EXTRA = auto()  # first of the moments behind the tensor's: window mass, energies
    FLOW_ROWS = auto()  # 2: columns of the motion itself
    OFFSET_CODES = FLOW_ROWS + 2  # 6: offset of each motion row: 0 = "1", 1.. = AXES
    MOTION_ROWS = OFFSET_CODES + 6  # MAX_ROWS: columns of the motion rows
    CAMERA_ROWS = MOTION_ROWS + MAX_ROWS  # 2 x MAX_ROWS: columns of the geometry rows per camera solution
    CAMERA_AXIS = CAMERA_ROWS + 2 * MAX_ROWS  # 2: 0 for sx, 1 for sy
    CROSS_AB = CAMERA_AXIS + 2  # 2 x 9 x 3: a, b, moment
    BRIGHTNESS_PLANES = CROSS_AB + 54  # 4: output plane of each brightness row, from BRIGHTNESS_T on
    CENTRE = BRIGHTNESS_PLANES + 4  # MAX_CENTRE_TERMS x 2: column of a parameter, column of what is added to it
    MOVE = CENTRE + 2 * MAX_CENTRE_TERMS  # 2 x 2: columns of the flow's derivatives along x, y
    PARTNER = MOVE + 4  # MAX_COLUMNS: column of an own flow for each column of the reference model, or -1
    PLACE = PARTNER + MAX_COLUMNS  # MAX_UNKNOWNS: where each component of the motion stands among the unknowns, or -1
    CONSTANT = PLACE + MAX_UNKNOWNS  # MAX_COLUMNS: 1 for columns without an offset
    LOWER = CONSTANT + MAX_COLUMNS  # N (N + 1) / 2: plane of each element of the lower triangle
    # Behind them NOISE_TERMS x 2: element of the lower triangle, moment.


class Value(IntEnum):
    """Positions in the table ``value``."""

    RIDGE = 0
    F = auto()
    PX = auto()  # principal point
    PY = auto()
    BASELINE = auto()  # 2
    SHIFT = BASELINE + 2  # 2: disparity that the preshift and the rectification took out, px per step
    MOTION_SHIFT = SHIFT + 2  # 2: motion that the images were shifted by, px per frame
    STEP_SIZE = MOTION_SHIFT + 2  # relative step of the finite differences in the motion fit
    DENOISE = auto()  # share of the gradients' noise that is taken out of J_ff in the covariances
    MODEL_ERROR = auto()  # 7: relative, per offset code of a row, the last one of the range constraint
    TURNING_ERROR = MODEL_ERROR + 7  # of mixed derivatives, per turning
    SECOND_MOMENT = TURNING_ERROR + 1  # 2: of the window along x, y, px²
    CAMERA_STEP = SECOND_MOMENT + 2  # 2: steps of an own flow's camera from the reference
    GAIN = CAMERA_STEP + 2  # noise gain of the gradient: x and y
    MIN_MASS = auto()
    MIN_STRUCTURE = auto()  # least gradient energy per energy of the image
    ROUGHEST = auto()  # share of the gradient's energy that one more smoothing leaves, below which it is noise
    MAX_RESIDUAL = auto()  # px, for status incoherent
    MAX_SHIFT = auto()  # px per step or frame, likewise
    MOTION_SCALE = auto()  # 2: mm per px of range flow's U', V', and of W
    NOISE_LEVEL = MOTION_SCALE + 2  # variance of the image noise as far as it is known beforehand, else 0
    LEAST_SHARE = auto()  # share of the gradient's mean energy that is no texture where there is less noise than that
    UNKNOWN = auto()  # noise over information at which a direction of the parameters is not determined
    MISFIT = auto()  # px²: square of the misfit that is the model's, for the confidence
    GAP = auto()  # convergence: residual per gap
    SCALE_START = auto()  # σ² of the penalty: first one, per mean squared residual
    SCALE_SHRINK = auto()  # from one round to the next
    LEAST_NOISE = auto()  # least one: per variance of the noise, and
    LEAST_DISPLACED = auto()  # per squared gradient, px²
    MOST_NOISE = auto()  # largest squared residual of a plain fit that did not fail, likewise
    MOST_DISPLACED = auto()
    RELAXATION = auto()  # factor of a relaxation step
    MAX_CONTRADICTION = auto()  # of an own flow's rows and the reference's motion, per variance
    SCALE = auto()  # MAX_COLUMNS
    NOISE = SCALE + MAX_COLUMNS  # MAX_COLUMNS: C
    CROSS = NOISE + MAX_COLUMNS  # 2 x 9
    CENTRE = CROSS + 18  # MAX_CENTRE_TERMS: factors
    PARTNER = CENTRE + MAX_CENTRE_TERMS  # MAX_COLUMNS: factors of the noise shared with the reference model
    DIFFERENCE = PARTNER + MAX_COLUMNS  # 2 x 7: by axis and offset code of a row; roots of sampling.difference_variance
    RATIO = DIFFERENCE + 14  # k x packed [F], then k x NOISE_TERMS
