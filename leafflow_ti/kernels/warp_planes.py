"""How the arrays of ``warp`` are laid out, for those who fill them."""

MARGIN = 2
"""Coefficients beside an image that its border pixels need."""
TEXTURE, SLOPE, LEVER, SQUARES, COUNT = range(5)
"""Planes of ``follow_kernel``: T, p, S, sum of the squared residuals of a constant, number of images less one."""
