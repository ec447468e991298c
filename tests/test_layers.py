"""The layout as tests: import directions, one door to the engine, kernel signatures, and what starting costs."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import leafflow_ti

PACKAGE = Path(leafflow_ti.__file__).parent

LAYERS: dict[str, int] = {
    **dict.fromkeys(("errors", "status", "progress", "trace", "background", "number_text", "whole"), 1),
    **dict.fromkeys(("unit_marks",), 1),
    **dict.fromkeys(("chunk_files", "events", "locks", "placing", "memory", "stopping", "kernel_cache"), 1),
    **dict.fromkeys(("kernels",), 2),
    **dict.fromkeys(
        (
            "capture",
            "models",
            "config",
            "config_sections",
            "config_values",
            "geometry",
            "field",
            "filters",
            "sampling",
            "range_flow",
        ),
        3,
    ),
    **dict.fromkeys(("presets", "blocks", "uneven", "splines", "refine_plan", "noise", "aim", "rates", "mesh"), 3),
    **dict.fromkeys(("synthetic", "metrics"), 3),
    **dict.fromkeys(("runtime", "ceilings"), 4),
    **dict.fromkeys(("stages",), 5),
    **dict.fromkeys(("growth", "refinement", "identify", "principal", "deformation", "curvature"), 5),
    **dict.fromkeys(("store_arrays", "store_check"), 6),
    **dict.fromkeys(("search", "bands", "model_plan", "plan", "disk", "reading", "engines", "pipeline"), 6),
    **dict.fromkeys(("results", "work", "stays", "units", "surfaces", "adaptive"), 6),
    **dict.fromkeys(("refinement", "refine_work"), 6),
    **dict.fromkeys(("range_plan", "range_source", "range_engine"), 6),
    **dict.fromkeys(("matching", "positions", "photometry"), 3),
    **dict.fromkeys(("expected", "correlation"), 6),
    **dict.fromkeys(("colours", "display"), 2),
    **dict.fromkeys(("panels", "report"), 7),
    **dict.fromkeys(("surface_growth",), 7),
    **dict.fromkeys(
        (
            "provenance",
            "run_store",
            "schedule",
            "worker",
            "executors",
            "runs",
            "growing",
            "arriving",
            "filling",
        ),
        7,
    ),
    **dict.fromkeys(("quicklook", "api", "profiling", "profile_cases", "profile_report"), 7),
    **dict.fromkeys(("tables",), 3),
    **dict.fromkeys(("exporters", "labels", "following", "region_noise", "region_divergence"), 7),
    **dict.fromkeys(("region_rows", "region_table", "regions", "diel"), 7),
    **dict.fromkeys(("napari_reader",), 7),
    **dict.fromkeys(("rig", "rig_choices", "inspection", "inspection_advice", "inspection_report"), 7),
    **dict.fromkeys(("drift", "interpolation", "neighbourhood"), 3),
    **dict.fromkeys(("backend",), 7),
    **dict.fromkeys(("point_maps", "tracks", "tracking", "cumulative", "leaf_axes"), 7),
    **dict.fromkeys(("cli",), 8),
}
"""Part of the package -> layer. A part imports from lower layers and, without cycles, from its own."""

FORBIDDEN: dict[str, set[str]] = {
    "synthetic": {"kernels", "models"},  # the oracle stays independent of what it judges
    "metrics": {"kernels", "models"},
}

ENGINES = ("taichi", "quadrants")


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def dotted(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree: ast.AST) -> Iterator[str]:
    """Dotted names of all imports, those inside functions and for type checkers too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports are not used here"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            yield from (arg.value for arg in node.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str))


def parts_imported(path: Path) -> set[str]:
    names = imported(ast.parse(path.read_text(encoding="utf-8")))
    inside = {name.split(".")[1] for name in names if name.startswith("leafflow_ti.")}
    return {name for name in inside if name != "__version__"}


def inner_modules() -> list[Path]:
    return [path for path in modules() if path != PACKAGE / "__init__.py"]


@pytest.mark.parametrize("path", inner_modules(), ids=dotted)
def test_imports_point_downwards(path: Path) -> None:
    part = part_of(path)
    assert part in LAYERS, f"{part} has no layer: add it to LAYERS"
    for other in parts_imported(path):
        assert other in LAYERS, f"{dotted(path)} imports {other}, which has no layer: add it to LAYERS"
        assert LAYERS[other] <= LAYERS[part], f"{dotted(path)} (layer {LAYERS[part]}) imports {other} above it"
        assert other not in FORBIDDEN.get(part, set()), f"{dotted(path)} must not import {other}"


def test_parts_of_one_layer_import_without_cycles() -> None:
    graph: dict[str, set[str]] = {}
    for path in inner_modules():
        graph.setdefault(part_of(path), set()).update(parts_imported(path) - {part_of(path)})

    def visit(part: str, above: tuple[str, ...]) -> None:
        assert part not in above, f"cycle: {' -> '.join((*above, part))}"
        for other in graph.get(part, set()):
            visit(other, (*above, part))

    for part in graph:
        visit(part, ())


@pytest.mark.parametrize("path", modules(), ids=dotted)
def test_only_the_engine_module_imports_the_engine(path: Path) -> None:
    found = {name for name in imported(ast.parse(path.read_text(encoding="utf-8"))) if name.split(".")[0] in ENGINES}
    assert not found or path == PACKAGE / "kernels" / "engine.py", f"{dotted(path)} imports {found}: use kernels.engine"


@pytest.mark.parametrize("path", [p for p in modules() if part_of(p) == "kernels"], ids=dotted)
def test_kernel_modules_keep_their_annotations(path: Path) -> None:
    assert "__future__" not in {name.split(".")[0] for name in imported(ast.parse(path.read_text(encoding="utf-8")))}


IMPORT_ALL = """
import importlib, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
print(*[engine for engine in ("taichi", "quadrants") if engine in sys.modules])
"""


def test_importing_loads_no_engine() -> None:
    names = [dotted(path) for path in modules() if part_of(path) != "kernels"]
    done = subprocess.run([sys.executable, "-c", IMPORT_ALL, *names], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


HELP = """
import sys
from leafflow_ti.cli.main import main
try:
    main(["--help"])
except SystemExit as end:
    assert not end.code, end.code
print(*[name for name in ("taichi", "numpy", "zarr", "pydantic", "rich") if name in sys.modules])
"""


def test_help_loads_nothing_heavy() -> None:
    done = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True, check=True)
    assert "Usage: leafflow-ti" in done.stdout
    assert done.stdout.splitlines()[-1] == ""


def cpu_seconds(*command: str) -> float:
    """Least CPU time, user and system, of three runs of ``python command``."""
    import resource

    def once() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    return min(once() for _ in range(3))


@pytest.mark.skipif(sys.platform == "win32", reason="CPU time of child processes is a POSIX facility")
def test_help_costs_under_half_a_second_of_cpu() -> None:
    assert cpu_seconds("-m", "leafflow_ti.cli.main", "--help") - cpu_seconds("-c", "pass") < 0.5


ARRAY_ORDER = ("scalar", "in", "inout", "out")
SUFFIXES = {"_in": "in", "_io": "inout", "_tmp": "inout", "_out": "out"}


def signature_faults(source: str) -> list[str]:
    """What is wrong with the parameters of the kernels in ``source``: one line each."""
    lines, faults = source.splitlines(), []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.FunctionDef):
            continue
        decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
        if "ti.kernel" in decorators:
            faults.append(f"{node.name}: kernels are made by engine.Kernel, which makes them safe under any host")
        if not {"Kernel", "ti.kernel"} & {*decorators}:
            continue
        order = []
        for arg in node.args.args:
            where = f"{node.name}({arg.arg})"
            kind = next((kind for suffix, kind in SUFFIXES.items() if arg.arg.endswith(suffix)), None)
            if arg.annotation is None:
                faults.append(f"{where}: no annotation")
                continue
            is_array = "ndarray" in ast.unparse(arg.annotation)
            if is_array != (kind is not None):
                faults.append(f"{where}: arrays, and only arrays, end in {', '.join(SUFFIXES)}")
            if is_array and not re.search(r"#\s*\[", lines[(arg.annotation.end_lineno or 0) - 1]):
                faults.append(f"{where}: no comment '# [shape]' on its line")
            order.append(ARRAY_ORDER.index(kind or "scalar"))
        if order != sorted(order):
            faults.append(f"{node.name}: parameters must come as scalars, _in, _io and _tmp, _out")
    return faults


@pytest.mark.parametrize("path", [p for p in modules() if part_of(p) == "kernels"], ids=dotted)
def test_kernel_signatures(path: Path) -> None:
    assert signature_faults(path.read_text(encoding="utf-8")) == []


A = "ti.types.ndarray(dtype=ti.f32, ndim=1),  # [n]\n"


@pytest.mark.parametrize(
    ("parameters", "fault"),
    [
        (f"n: ti.i32, a_in: {A} b_tmp: {A} c_io: {A} d_out: {A}", None),
        ("n, \n", "no annotation"),
        (f"a: {A}", "arrays, and only arrays"),
        ("n_in: ti.i32, \n", "arrays, and only arrays"),
        ("a_in: ti.types.ndarray(),\n", "no comment"),
        (f"a_in: {A} n: ti.i32, \n", "must come as"),
        (f"a_out: {A} b_in: {A}", "must come as"),
        (f"a_out: {A} b_tmp: {A}", "must come as"),
    ],
)
def test_signature_check_finds_faults(parameters: str, fault: str | None) -> None:
    found = signature_faults(
        f"@functools.cache\ndef make(spec):\n    @Kernel\n    def k({parameters}    ):\n        pass\n"
    )
    assert len(found) == (fault is not None)
    assert all(fault is not None and fault in line for line in found)
