"""What the kernels of the refinement share: sizes, tables and the workspace of one output pixel.

An output pixel works in two workspaces: one of the type of the images (a *sample* vector holds ``lanes`` samples of the
window), one of the type of the algebra (an *image* vector holds ``lanes`` of the images). Both are also passed as plain
numbers, for what belongs to a single image or to the pixel.
"""

from enum import IntEnum, auto

SHIFTS = 8
"""Functions of the window that a small homography moves the texture by (see ``refine_warp``)."""
TERMS = 6
"""Most photometric terms of an image."""
FUNCTIONS = SHIFTS + TERMS
MAX_NEIGHBOURS = 16
DERIVATIVES = 6
"""Of a sample: value, x, y, xx, xy, yy."""
MAX_UNKNOWNS = 15
"""Z0, ZX, ZY, N, Ω, A, and up to three growth rates."""
START = MAX_UNKNOWNS + 5
"""Numbers that a pixel starts from: x0, y0, its parameters, its curvature."""
GROWTH = 12
"""Where the growth rates stand among the unknowns, all of which are kept, estimated or not."""


class Size(IntEnum):
    """Entries of the table ``size`` (int32)."""

    UNKNOWNS = 0  # that are estimated
    MODES = auto()  # growth rates: 0, 1 isotropic, 3
    TERMS = auto()  # photometric terms of an image
    IMAGES = auto()
    IMAGE_GROUPS = auto()  # vectors of images
    SAMPLES = auto()
    SAMPLE_GROUPS = auto()
    ACROSS = auto()  # samples along one side of the window
    STEPS = auto()  # most steps
    PITCH = auto()  # of the coefficients' planes
    MASKED = auto()  # whether the window is masked
    NEIGHBOURS = auto()  # lattice steps over which the noise is correlated
    SLOT_REAL = auto()  # sample vectors of a pixel's workspace
    SLOT_PRECISE = auto()  # image vectors of it
    # Regions of the first, in sample vectors.
    SEEN = auto()  # [images, DERIVATIVES, sample groups]: warped images; NOTHING where there is none
    VALUES = auto()  # [images, sample groups]: the same where the warps are now
    TEXTURE = auto()
    BEFORE = auto()  # texture of the pass before
    FUNCTION = auto()  # [FUNCTIONS, sample groups]
    BLUR = auto()  # [3, sample groups]: second derivatives of the texture
    WEIGHT = auto()
    SCRATCH = auto()  # [2 SHIFTS, sample groups]
    SPLINES = auto()  # [2, 3, taps]: weights of the neighbours along x and y, and their derivatives
    WARP = auto()  # [images, Warp.N] numbers
    # Regions of the second, in image vectors.
    MOVES = auto()  # [SHIFTS, unknowns, groups]: what a step of an unknown does to the functions
    SUMS = auto()  # [FUNCTIONS, groups]: residual times functions
    ENERGY = auto()  # [groups]: squared residual
    MASS = auto()  # [groups]: weight of the valid samples
    TRUST = auto()  # [groups]: weight of an image
    KEPT = auto()  # [groups]: 1, or 0 for an image that does not take part
    GAIN = auto()  # [TERMS, groups]
    GAIN_STEP = auto()  # [TERMS, groups]
    HOMOGRAPHY = auto()  # [Warp.GAIN, groups]
    PRODUCT = auto()  # [SHIFTS]
    NORMAL = auto()  # packed [unknowns]: sums of normal equations
    RIGHT = auto()  # [unknowns]
    HALVES = auto()  # [2, SHIFTS, groups]: right minus left, below minus above, of SUMS
    SCALAR = auto()  # numbers of the pixel, see Scalar
    GEOMETRY = auto()  # [Geometry.N]: what the warps of a vector of images are made of
    LIST = auto()  # [unknowns]: which of MAX_UNKNOWNS are estimated; the last entries


class Warp(IntEnum):
    """Numbers of one image's warp."""

    H = 0  # [8]: homography from the window to the image, both about their centres; its last entry is 1
    D = 8  # [4]: ∂x/∂δ at the centre, row by row
    BLUR = 12  # [3]: weights of the texture's second derivatives xx, xy, yy
    BEND = 15  # [3]: what the curvature of the surface adds, to x, y and the divisor
    GAIN = 18  # [TERMS]
    TRUST = 24
    SAMPLED = 25  # [8]: homography with which the image was sampled
    N = 33


class Geometry(IntEnum):
    """Image vectors from which warps are made; matrices row by row."""

    R = 0  # [3, 3]
    TURN = 9  # [3, 3]: left Jacobian of the rotation
    ML = 18  # [3, 2]: R G L
    H = 24  # [3, 3]
    INVERSE = 33  # [3, 3]
    GAMMA = 42  # [3]
    PLAIN = 45  # [3, 2]: columns before they are turned
    TRACK = 51  # [3, 3]: what the acceleration moves the patch by, in t²/2
    N = 60


class Image(IntEnum):
    """Fields of the table ``image``, each [groups]; 0 in lanes without an image."""

    PRESENT = 0
    TIME = auto()  # frames from the reference
    CAMERA_X = auto()  # mm
    CAMERA_Y = auto()
    SHIFT_X = auto()  # px: where the image's block lies, beside the disparity seen in the images
    SHIFT_Y = auto()
    N = auto()


class Value(IntEnum):
    """Entries of the table ``value``."""

    FOCAL = 0
    SMOOTHING = auto()  # ½ variance of what smooths each image, px²
    HALF = auto()  # half the window, px
    LIMIT = auto()  # farthest that a sample may lie from the centre of its block, px
    CORRELATION = auto()  # sum of the noise correlation over the lattice times Σw² / Σw
    CORRELATION_AT = 8  # [MAX_NEIGHBOURS]: noise correlation along one axis at 0, 1, ... steps of the lattice
    SPLINE = CORRELATION_AT + MAX_NEIGHBOURS  # [3, taps, taps]: weights and two derivatives: neighbour, power


class Scalar(IntEnum):
    """Numbers of a pixel, behind one another."""

    Q = 0  # [MAX_UNKNOWNS]
    ACCEPTED = 16  # [MAX_UNKNOWNS]: the best so far
    STEP = 32  # [unknowns]
    RIGHT = 48  # [unknowns]
    SCALE = 64  # [unknowns]
    FIXED = 80  # [unknowns]: 1 where the data do not determine it
    GRAM = 96  # [FUNCTIONS, FUNCTIONS]
    TERMS = 292  # [TERMS, TERMS]: Cholesky factor of the photometric part
    SOLVED = 328  # [TERMS, SHIFTS]: what the photometric terms take of the shifts
    METRIC = 376  # [SHIFTS, SHIFTS]: GRAM of the shifts without that
    MEAN = 440  # [SHIFTS, unknowns]: moves, averaged over the images
    NORMAL = 560  # [unknowns, unknowns]: scaled normal matrix, then its Cholesky factor
    INVERSE = 785  # [unknowns, unknowns]
    NOISE = 1010  # [SHIFTS, SHIFTS]
    SPREAD = 1074  # [unknowns, unknowns]
    X0 = 1299  # of the pixel, from the principal point
    Y0 = 1300
    COST = 1301  # of the last pass: mean squared residual
    BEST = 1302  # of the accepted one
    START = 1303  # of the start
    LAST = 1304  # square of the last step, in the metric of the normal equations
    LEFT = 1305  # the same of what is left to go
    BACK = 1306  # factor of a step that had to be shortened
    PASSES = 1307
    DONE = 1308
    CODE = 1309
    MASS = 1310  # of the window
    IMAGES = 1311  # weight of all images, against one whose window is all valid
    ROBUST = 1312  # square of the residual beyond which a sample has no weight; 0: all have
    RAY = 1313  # [3]: r0
    ETA = 1316  # [2], and its derivatives by ZX and ZY [2, 2]
    LIFT = 1322  # [3, 2]: L
    MODES = 1328  # [3, 3, 2]: E_j L of the growth rates
    EFFECTIVE = 1346  # samples of equal weight that the window stands for
    RESAMPLE = 1347  # whether the images are sampled in this pass
    DRIFT = 1348  # px that the warps have moved since
    SAMPLINGS = 1349  # passes in which they were
    CURVATURE = 1350  # [3]: K, xx, xy, yy
    N = 1360


class Code(IntEnum):
    """What became of a pixel."""

    REFINED = 0
    NOT_CONVERGED = 1
    SINGULAR = 2
    EMPTY = 3
    WORSE = 4


class Out(IntEnum):
    """Numbers that are written for each pixel."""

    CODE = 0
    PASSES = auto()
    SAMPLINGS = auto()
    START = auto()  # mean squared residual of the start
    COST = auto()
    Q = auto()  # [MAX_UNKNOWNS]
    COVARIANCE = Q + MAX_UNKNOWNS  # [MAX_UNKNOWNS, MAX_UNKNOWNS]
    N = COVARIANCE + MAX_UNKNOWNS * MAX_UNKNOWNS


SHOWN = 3
"""Plane of SCRATCH, behind those of the texture's blur: how many images show a sample."""
ADDRESSED = 1 << 30
"""Coefficients that a pixel can be sampled from: their indices are cut to so many."""
NOTHING = 1e30
"""Stands for a value that there is none of, in coefficients and warped images."""
