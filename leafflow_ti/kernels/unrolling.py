"""Keeps the compiler behind the engine from unrolling loops on processors of which it has a wrong description.

Of AMD's family 25 (Zen 3 and 4) LLVM 15 believes that loops of up to 4096 instructions are best unrolled. Kernels then
grow fourfold: measured, the default model was compiled in 70 s instead of 10, and loaded from the cache in 27 s instead
of 3, for no gain in speed. And the copies of a loop's body are rounded differently from what is left over at its end,
so that values depend on where a tile ends.
"""

import ast
import contextlib
import copy
import functools
import importlib
import platform
import re
from pathlib import Path

FAMILY = 25
NEVER = "float({0}) * float({0}) == 2.0"
"""No whole number is a root of two, which the compiler does not know: it takes the loop for one that may end early, and
such loops it leaves alone."""


@functools.cache
def unrolls_too_much() -> bool:
    """Whether this machine's processor is of the family."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace")
        found = re.search(r"vendor_id\s*:\s*AuthenticAMD\s.*?cpu family\s*:\s*(\d+)", text, re.DOTALL)
    except OSError:  # not Linux
        found = re.search(r"AMD64 Family (\d+) .*AuthenticAMD", platform.processor())
    return found is not None and int(found[1]) == FAMILY


@contextlib.contextmanager
def loops_as_written(engine, innermost):
    """Kernels compiled inside keep their loops, all but the parallel one.

    ``engine``: the name of its package; ``innermost``: loops without loops in them, too. These may be of plain numbers,
    which are made vectors only where the loop cannot end early: measured on the refinement, a fifth of its speed.
    """
    transformer = importlib.import_module(f"{engine}.lang.ast.ast_transformer").ASTTransformer
    usual = transformer.build_range_for

    def build(context, node):
        parallel = context.is_kernel and len(context.loop_scopes) == 1
        if not parallel and (innermost or _around_loops(node)):
            node = copy.copy(node)
            node.body = [_never(node), *node.body]
        return usual(context, node)

    transformer.build_range_for = staticmethod(build)
    try:
        yield
    finally:
        transformer.build_range_for = staticmethod(usual)


def _around_loops(node):
    return any(isinstance(inner, ast.For | ast.While) for line in node.body for inner in ast.walk(line))


def _never(node):
    """An end of a loop that is never reached."""
    end = ast.parse(f"if {NEVER.format(node.target.id)}: break").body[0]
    for part in ast.walk(end):
        ast.copy_location(part, node)
    return end
