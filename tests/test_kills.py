"""A run that is killed at random moments ends, resumed, with the bytes of an undisturbed one."""

from __future__ import annotations

import sys

import pytest

from leafflow_ti.kernel_cache import cache_folder
from perf.kills.captures import OPTIONS, Variant
from perf.kills.case import Settings, measure

FLOW = Variant("flow", "stack", (*OPTIONS, "--model", "flow", "--refine", "0"))
"""Quick kernels."""


@pytest.mark.skipif(sys.platform == "win32", reason="process groups and SIGKILL are facilities of POSIX")
def test_killed_runs_end_like_an_undisturbed_one() -> None:
    outcome = measure(Settings(("serial",), kills=2, seed=1, chains=1, variants=(FLOW,), cache=cache_folder()))
    assert all(figure.met is not False for figure in outcome.figures), outcome.notes
