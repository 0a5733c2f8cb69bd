# SPDX-License-Identifier: Apache-2.0
"""Who may import whom, and other rules that a reader of one file cannot see."""

import ast
import functools
import itertools
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "vitamin3d"
FILES = sorted(ROOT.rglob("*.py"))
NAMES = [str(path.relative_to(ROOT)) for path in FILES]
SPARSE = ("image", "tracking", "localization", "mapping", "initialization", "sparse_map", "steps")
FORBIDDEN = {
    "errors": ("",),
    "_jit": ("",),
    "types": ("config", "geometry", *SPARSE, "dense", "datasets", "exporters"),
    "config": ("types", "geometry", *SPARSE, "dense", "datasets", "exporters"),
    "geometry": ("bundle_adjustment", *SPARSE, "dense", "datasets", "exporters"),
    "bundle_adjustment": (*SPARSE, "dense", "datasets", "exporters"),
    "tracking": ("bundle_adjustment", "mapping", "dense", "datasets", "exporters"),
    **dict.fromkeys(("image", "localization", "mapping", "initialization", "sparse_map", "steps"), ("dense", "datasets", "exporters")),
    "dense": ("tracking", "mapping", "datasets", "exporters"),
    "datasets": (*SPARSE, "dense", "exporters"),
    "exporters": (*SPARSE, "dense", "datasets"),
    "evaluation": (*SPARSE, "dense"),
}
"""Unit -> what it must not import from `vitamin3d.`; the empty name: nothing of ours at all."""
STEPS = ("image", "tracking", "localization", "mapping", "dense", "initialization")
MAY_USE = {
    "image": (),
    "tracking": ("image",),
    "localization": ("image",),
    "mapping": ("image",),
    "dense": (),
    "initialization": ("image", "tracking", "localization", "mapping"),
    "growing_array": (),
    "sparse_map": ("image",),
    "steps": (),
}
"""Unit -> which of the steps, besides itself, it may import from: what two of them need lies below both, or is told to them."""
ABOVE = (
    "slam",
    "slam_steps",
    "succession",
    "atlas",
    "map_output",
    "reconstruction",
    "warmup",
    "workers",
    "runtime",
    "job",
    "run_statistics",
    "run_report",
    "benchmark",
    "progress",
    "commands",
    "cli",
)
LAZY = ("open3d", "pymeshlab")
MAX_LINES = 60
MAX_CLASS_LINES = 200
ON_A_PAGE = {"slam.py": 200, "reconstruction.py": 200}
"""Modules that are read from top to bottom, and how many lines they have at most."""
MIRRORED = (
    "bundle_adjustment",
    "commands",
    "datasets",
    "dense",
    "evaluation",
    "exporters",
    "geometry",
    "image",
    "initialization",
    "localization",
    "mapping",
    "tracking",
)
TEST_FILES = [path for folder in MIRRORED for path in sorted((ROOT.parent / "tests" / folder).rglob("test_*.py"))]


@functools.cache
def tree(path):
    return ast.parse(path.read_text())


def unit(path):
    """`geometry` of geometry/se3.py, `slam` of slam.py."""
    return path.relative_to(ROOT).with_suffix("").parts[0]


def imports(node):
    """Names of the modules that a tree imports, wherever."""
    for statement in ast.walk(node):
        if isinstance(statement, ast.Import):
            yield from (alias.name for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom):
            assert statement.level == 0, "imports are absolute"
            yield statement.module


def importers(*modules):
    return {name for name, path in zip(NAMES, FILES, strict=True) if {m.split(".")[0] for m in imports(tree(path))} & set(modules)}


def of_ours(path):
    """Names of our modules that a file imports, after `vitamin3d.`."""
    return [m.removeprefix("vitamin3d").lstrip(".") for m in imports(tree(path)) if m.split(".")[0] == "vitamin3d"]


def functions(path):
    return [node for node in ast.walk(tree(path)) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]


def test_there_is_something_to_check():
    assert len(FILES) > 40 and {"slam.py", "sparse_map.py", "dense/nltgv.py"} <= set(NAMES)


def test_numba_is_imported_in_two_files():
    assert importers("numba") == {"_jit.py", "_simd.py"}


def test_threads_are_known_to_one_file():
    assert importers("threading", "queue", "multiprocessing", "concurrent", "asyncio") == {"workers.py"}


def test_heavy_libraries_are_imported_where_they_are_used():
    others = {"evaluation/surface_error.py", "datasets/point_files.py"}  # samples as in other people's scripts; the files of PCL
    assert all(name.startswith(("dense/", "exporters/")) or name in others for name in importers("open3d"))
    assert all(name.startswith("dense/") for name in importers("pymeshlab"))
    for path in FILES:
        at_import = [node for node in tree(path).body if not isinstance(node, (ast.FunctionDef, ast.ClassDef))]
        at_import += [n for c in tree(path).body if isinstance(c, ast.ClassDef) for n in c.body if not isinstance(n, ast.FunctionDef)]
        eager = {m.split(".")[0] for node in at_import if not is_type_checking(node) for m in imports(node)}
        assert not eager & set(LAZY), path


def is_type_checking(node):
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_layers(path):
    ours = of_ours(path)
    for module, bad in itertools.product(ours, FORBIDDEN.get(unit(path), ())):
        assert bad and module.split(".")[0] != bad, f"{unit(path)} imports {module}"
    if unit(path) in FORBIDDEN:
        assert not {module.split(".")[0] for module in ours} & set(ABOVE)


@pytest.mark.parametrize("name", MAY_USE)
def test_no_step_knows_the_one_beside_it(name):
    files = [path for path in FILES if unit(path) == name]
    used = {module.split(".")[0] for path in files for module in of_ours(path)}
    assert files and used & set(STEPS) <= {name, *MAY_USE[name]} and not used & set(ABOVE)


def test_no_drawer_for_odds_and_ends():
    words = {"utils", "util", "common", "helpers", "helper", "misc"}
    assert not {part for path in FILES for part in path.relative_to(ROOT).with_suffix("").parts} & words


def test_kernels_are_neither_parallel_nor_fast_and_loose():
    for path in FILES:
        for call in (node for node in ast.walk(tree(path)) if isinstance(node, ast.Call)):
            assert not {keyword.arg for keyword in call.keywords} & {"parallel", "fastmath"}, path


def is_kernel(function):
    return any(isinstance(d, ast.Name) and d.id in ("kernel", "inlined") for d in function.decorator_list)


def test_functions_fit_on_a_page():
    sizes = {
        f"{name}:{function.name}": function.end_lineno - function.lineno + 1
        for name, path in zip(NAMES, FILES, strict=True)
        for function in functions(path)
        if not is_kernel(function)
    }
    assert len(sizes) > 200
    assert {name: size for name, size in sizes.items() if size > MAX_LINES} == {}


def test_classes_fit_on_a_few_pages():
    sizes = {
        f"{name}:{node.name}": node.end_lineno - node.lineno + 1
        for name, path in zip(NAMES, FILES, strict=True)
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ClassDef)
    }
    assert len(sizes) > 100
    assert {name: size for name, size in sizes.items() if size > MAX_CLASS_LINES} == {}


@pytest.mark.parametrize("name", ON_A_PAGE)
def test_what_is_read_from_top_to_bottom_is_short(name):
    assert len((ROOT / name).read_text().splitlines()) <= ON_A_PAGE[name]


def what_may_be_tested(folder):
    """Modules and packages of a folder, and the functions of its `__init__.py`."""
    init = [node.name for node in tree(folder / "__init__.py").body if isinstance(node, ast.FunctionDef)]
    return {*init, *(path.stem for path in folder.iterdir() if path.suffix == ".py" or path.is_dir())}


@pytest.mark.parametrize("path", TEST_FILES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_tests_are_where_one_looks_for_them(path):
    """test_adjust.py and test_adjust_solvers.py are about adjust.py in the folder of the same name."""
    about, folder = path.stem.removeprefix("test_"), ROOT / path.parent.relative_to(ROOT.parent / "tests")
    assert any(about == name or about.startswith(f"{name}_") for name in what_may_be_tested(folder))


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_the_licence_comes_first(path):
    assert path.read_text().startswith("# SPDX-License-Identifier: Apache-2.0\n")


@pytest.mark.parametrize("path", [path for path in FILES if path.name != "__init__.py"], ids=[n for n in NAMES if "__init__" not in n])
def test_what_is_public_is_documented(path):
    assert ast.get_docstring(tree(path)), "the module"
    public = [node for node in tree(path).body if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_")]
    missing = [node.name for node in public if not ast.get_docstring(node)]
    assert missing == []
