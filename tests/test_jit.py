# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels that hold functions of before."""

import pytest

from vitamin3d._jit import STAMP, forget_stale_kernels


@pytest.fixture
def package(tmp_path):
    for name, text in (("a.py", "@inlined\ndef f(x): return x\n"), ("sub/b.py", "@kernel\ndef g(x): return f(x)\n")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    forget_stale_kernels(tmp_path)
    compiled = tmp_path / "sub" / "__pycache__" / "b.g.nbi"
    compiled.parent.mkdir()
    compiled.write_text("compiled")
    return tmp_path, compiled


def test_kernels_stay_while_nothing_that_is_inlined_changes(package):
    root, compiled = package
    (root / "sub" / "b.py").write_text("@kernel\ndef g(x): return 2 * f(x)\n")  # numba sees this itself
    forget_stale_kernels(root)
    assert compiled.exists()


@pytest.mark.parametrize("change", ["text", "name"])
def test_kernels_go_when_something_inlined_is_another_or_elsewhere(package, change):
    root, compiled = package
    if change == "text":
        (root / "a.py").write_text("@inlined\ndef f(x): return -x\n")
    else:
        (root / "a.py").rename(root / "c.py")
    forget_stale_kernels(root)
    assert not compiled.exists()
    compiled.write_text("compiled anew")
    forget_stale_kernels(root)
    assert compiled.exists()


def test_a_folder_that_cannot_be_written_is_left_alone(package):
    root, compiled = package
    (root / "__pycache__" / STAMP).unlink()
    (root / "__pycache__" / STAMP).mkdir()
    forget_stale_kernels(root)
    assert compiled.exists()
