"""Codes that steps and tables name, without the engine."""

from enum import IntEnum, auto


class Stage(IntEnum):
    """Number of each per-pixel stage."""

    LOAD = 0
    SCALE = auto()
    FACTORISE = auto()
    LEAST_SQUARES = auto()
    ACCEPT = auto()
    INVERSE_ITERATION = auto()
    JACOBI = auto()
    PARAMETERS = auto()
    RESIDUALS = auto()
    CENTRE = auto()
    CLEAN = auto()
    ROW_COVARIANCE = auto()
    ADD_CAMERA = auto()
    GEOMETRY = auto()
    RANGE_MOTION = auto()
    PATCH_FIT = auto()
    MEASURED = auto()
    MOTION = auto()
    EMIT = auto()
    # From here on: where windows may be cut. Who does not need what follows does not wait for its compilation.
    CUT_WINDOWS = auto()
    WHITEN = auto()
    UNWHITEN = auto()
    # From here on: of estimators that weigh windows anew.
    BEGIN_WEIGHTS = auto()
    REWEIGHT = auto()
    RELAX = auto()
    FUNDAMENTAL = auto()


AGAIN = 8
"""Added to ``Weights``: σ of the penalty begins anew, the pixels have been chosen."""
NARROW = 16
"""Added to ``Weights``: cells near the middle of the window count most."""


class Penalty(IntEnum):
    """How residuals count in a robust fit."""

    LORENTZIAN = 0
    GEMAN_MCCLURE = auto()
    TRUNCATED = auto()


class Weights(IntEnum):
    """What weighs the cells of a window."""

    NOISE = 0  # the inverse of their relative noise
    FUNDAMENTAL = auto()  # the same; WEIGHT_NOISE becomes what the fundamental scheme takes off
    PENALTY = auto()  # a penalty on residuals per relative noise, and the inverse of that noise
    PENALTY_PLAIN = auto()  # a penalty on residuals, all noise in the time-like columns
