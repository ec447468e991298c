"""Synthetic scenes with exact truth; they import no kernels and no estimation code: the oracle stays independent."""
