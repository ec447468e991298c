"""Kernels whose loops the compiler is kept from unrolling compute what they say."""

import ast
import importlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.kernels import engine, unrolling
from leafflow_ti.kernels.engine import ENGINE, ti
from leafflow_ti.runtime import Device

LANES = 4


def _kernel() -> Callable[..., None]:
    @ti.func
    def product(n, m):  # type: ignore[no-untyped-def]
        total = 0
        for i in range(1, n):
            for j in range(m):
                total += i * j
        return total

    @engine.lane_kernel(LANES, long=True)
    def products(size: ti.i32, m: ti.i32, out: ti.types.ndarray(dtype=ti.i32, ndim=1)):  # type: ignore[valid-type]
        for n in range(size):
            out[n] = product(n, m)
            for k in range(n):
                out[n] += 1000 * k

    return products  # type: ignore[no-any-return]


@pytest.mark.skipif(ENGINE != "taichi", reason="the compiler of other engines is newer")
@pytest.mark.parametrize("wrong", [True, False])
def test_loops_run_to_their_end(device: Callable[[str], Device], wrong: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    device("f64")
    ended: list[ast.stmt] = []

    def never(node: ast.For, usual: Callable[[ast.For], ast.stmt] = unrolling._never) -> ast.stmt:
        ended.append(usual(node))
        return ended[-1]

    monkeypatch.setattr(engine, "unrolls_too_much", lambda: wrong)
    monkeypatch.setattr(unrolling, "_never", never)
    out = np.zeros(7, np.int32)
    transformer = importlib.import_module(f"{ENGINE}.lang.ast.ast_transformer").ASTTransformer
    usual = transformer.build_range_for
    _kernel()(out.size, 5, out)
    assert out.tolist() == [10 * n * (n - 1) // 2 + 1000 * n * (n - 1) // 2 for n in range(7)]
    assert len(ended) == (3 if wrong else 0)  # all loops but the one that is parallel
    assert transformer.build_range_for is usual


def test_numbers_of_numpy_are_numbers(device: Callable[[str], Device]) -> None:
    """Without a warning, which is an error here: Quadrants makes one of ``numpy.int64``."""
    device("f64")
    out = np.zeros(3, np.int32)
    _kernel()(np.int64(3), np.int64(5), out)
    assert out.tolist() == [0, 0, 10 + 1000]


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("vendor_id\t: AuthenticAMD\ncpu family\t: 25\nmodel\t\t: 17\n", True),
        ("vendor_id\t: AuthenticAMD\ncpu family\t: 23\n", False),
        ("vendor_id\t: GenuineIntel\ncpu family\t: 6\n", False),
        ("processor\t: 0\nBogoMIPS\t: 50.00\n", False),
    ],
)
def test_processors_that_are_described_wrongly(
    text: str, wrong: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cpuinfo").write_text(text)
    monkeypatch.setattr(unrolling, "Path", lambda name: tmp_path / Path(name).name)
    assert unrolling.unrolls_too_much.__wrapped__() is wrong


def test_processor_of_a_system_without_cpuinfo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unrolling, "Path", lambda name: tmp_path / "absent")
    for name, wrong in (
        ("AMD64 Family 25 Model 33 Stepping 0, AuthenticAMD", True),
        ("Intel64 Family 6 Model 158 Stepping 9, GenuineIntel", False),
        ("arm", False),
    ):
        monkeypatch.setattr(unrolling.platform, "processor", lambda name=name: name)
        assert unrolling.unrolls_too_much.__wrapped__() is wrong
