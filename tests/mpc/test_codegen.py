"""The generated C: compiles without a warning, and computes what the Python law computes."""

import ctypes
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_mpc import integrator, scaled_suspension
from compiler import CC, needs_compiler
from plants import box, double_integrator, suspension
from random_problems import random_plant

from invariant_sets import Polytope
from mpc import InputError, LinearMPC

WARNINGS = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror"]

DRIVER = """
#include <stdio.h>
#include "mpc.h"
int main(int argc, char **argv)
{
    mpc_real theta[MPC_NT], u[MPC_NU];
    FILE *in = fopen(argv[1], "rb"), *out = fopen(argv[2], "wb");
    if (argc != 3 || !in || !out) return 1;
    while (fread(theta, sizeof(mpc_real), MPC_NT, in) == MPC_NT) {
        double row[MPC_NU + 1];
        int i;
        row[MPC_NU] = mpc_law(theta, u);
        for (i = 0; i < MPC_NU; i++) row[i] = u[i];
        fwrite(row, sizeof(double), MPC_NU + 1, out);
    }
    fclose(in);
    return fclose(out);
}
"""


def laws():
    A, B = double_integrator()
    yield LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=5, X=box([5, 5]), U=box([1]))
    A, B, _ = suspension()
    X = box([0.25, 2.5, 0.5, 2.5])
    yield LinearMPC(A, B, Q=[10, 1, 50, 5], R=[1e-6], horizon=3, X=X, U=box([1000.0]))
    yield random_plant(6)  # two inputs
    yield random_plant(4)  # two inputs, gains of 260: terms of 2600 u_max cancel


@pytest.fixture(scope="module")
def explicit_laws():
    return [mpc.explicit() for mpc in laws()]


def run_c(folder, theta, scalar):
    """Compile with warnings as errors and sanitizers, and run the states through."""
    (folder / "driver.c").write_text(DRIVER)
    program = folder / "driver"
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    subprocess.run([CC, *WARNINGS[:5], "-Werror", *sanitizers, "-g", "-O1", "mpc.c", "driver.c", "-o", program],
                   cwd=folder, check=True, capture_output=True, text=True)  # fmt: skip
    theta.astype(np.float64 if scalar == "double" else np.float32).tofile(folder / "in.bin")
    subprocess.run([program, "in.bin", "out.bin"], cwd=folder, check=True, capture_output=True, timeout=300)
    return np.fromfile(folder / "out.bin")


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize("which", [0, 1, 2, 3])
@pytest.mark.parametrize("method", ["tree", "sequential"])
@pytest.mark.parametrize(("scalar", "tolerance"), [("double", 1e-12), ("float", 1e-5)])
def test_c_agrees_with_python_on_1e5_states(explicit_laws, which, method, scalar, tolerance, tmp_path):
    law = explicit_laws[which]
    report = law.to_c(tmp_path, method=method, scalar=scalar)
    p = law.partition
    count = 100_000
    theta = p.centre + p.half * np.random.default_rng(which).uniform(-1.2, 1.2, size=(count, law.nt))
    if scalar == "float":
        theta = theta.astype(np.float32).astype(np.float64)
    out = run_c(tmp_path, theta, scalar).reshape(count, law.nu + 1)
    u, outside = law.evaluate(theta)
    u_max = np.abs(law.input_rows[1]).max()
    assert 0.05 < outside.mean() < 0.97
    assert np.abs(out[~outside, :-1] - u[~outside]).max() <= tolerance * u_max
    assert np.abs(out[:, :-1]).max() <= u_max * (1 + 1e-6)
    assert np.mean(out[:, -1] != outside) < (1e-4 if scalar == "float" else 1e-12)
    assert report.regions == len(law)


@needs_compiler
def test_compiles_with_strict_conversions(explicit_laws, tmp_path):
    for i, method in enumerate(("tree", "sequential")):
        for scalar in ("double", "float"):
            folder = tmp_path / f"{i}{scalar}"
            explicit_laws[0].to_c(folder, method=method, scalar=scalar)
            subprocess.run([CC, *WARNINGS, "-c", "mpc.c"], cwd=folder, check=True, capture_output=True)


@needs_compiler
@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize(
    ("U", "nearest"),
    [
        (box([1.0, 2.0]), [0.0, 0.0]),
        (([0.2, -1.0], [1.0, -0.5]), [0.2, -0.5]),
        (Polytope([[-1, -1], [1, 0], [0, 1], [-1, 0], [0, -1]], [-1, 1, 1, 1, 1]), [0.5, 0.5]),
    ],
    ids=["around zero", "box away from zero", "no box"],
)
def test_a_state_that_is_not_finite_is_reported_and_gives_the_input_nearest_to_zero(U, nearest, scalar, tmp_path):
    A, _ = double_integrator()
    law = LinearMPC(A, np.eye(2), Q=np.eye(2), R=0.1, horizon=2, X=(-5, 5), U=U).explicit()
    law.to_c(tmp_path, scalar=scalar)
    out = run_c(tmp_path, np.array([[np.nan, 0.0], [np.inf, 1.0], [0.0, -np.inf]]), scalar)
    np.testing.assert_allclose(out.reshape(3, 3), [[*nearest, 2]] * 3, atol=1e-7)


@needs_compiler
def test_the_input_stays_within_its_limits_a_little_beyond_the_border(explicit_laws, tmp_path):
    # in single precision the last 1e-5 beyond the border count as inside, and this law has gains of 260
    law = explicit_laws[3]
    law.to_c(tmp_path, scalar="float")
    p, border = law.partition, law.tree.border
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(5000, law.nt))
    share = (border[:, -1] - border[:, :-1] @ law.tree.centre) / np.maximum(ways @ border[:, :-1].T, 1e-300)
    points = law.tree.centre + ways * (share.min(axis=1, where=share > 0, initial=np.inf) * (1 + 3e-6))[:, None]
    out = run_c(tmp_path, p.centre + p.half * points, "float").reshape(-1, law.nu + 1)
    assert np.mean(out[:, -1] == 0) > 0.2
    assert np.abs(out[:, :-1]).max() <= np.abs(law.input_rows[1]).max()


@pytest.mark.quick(2)
def test_laws_cost_no_more_than_the_documents_say(tmp_path):
    table = (Path(__file__).parents[2] / "docs" / "benchmarks" / "mpc.md").read_text(encoding="utf-8")
    for controller in (integrator(20, 0.1), scaled_suspension(8), random_plant(4)):
        report = controller.explicit().to_c(tmp_path)
        stated = re.search(rf"{report.regions} regions, .*: (\d+) bytes .* (\d+) multiply-adds and (\d+) comp", table)
        assert stated, report
        for stated_cost, cost in zip(stated.groups(), (report.flash_bytes, report.operations, report.comparisons)):
            assert int(stated_cost) / 1.1 <= cost <= 1.1 * int(stated_cost)


@needs_compiler
def test_report_counts_the_bytes_of_the_tables(explicit_laws, tmp_path):
    for method in ("tree", "sequential"):
        folder = tmp_path / method
        report = explicit_laws[1].to_c(folder, method=method)
        subprocess.run([CC, "-std=c99", "-O2", "-c", "mpc.c"], cwd=folder, check=True)
        shown = subprocess.run(["size", "-A", "mpc.o"], cwd=folder, check=True, capture_output=True, text=True).stdout
        constants = sum(int(line.split()[1]) for line in shown.splitlines() if line.split()[:1] == [".rodata"])
        assert report.flash_bytes == pytest.approx(constants, rel=0.05)
        assert f"{report.flash_bytes} bytes" in str(report)


def test_gains_and_hyperplanes_are_stored_once(explicit_laws, tmp_path):
    law = explicit_laws[0]
    report = law.to_c(tmp_path, method="sequential")
    assert report.laws < report.regions
    assert report.hyperplanes < len(law.partition.H)
    tree = law.to_c(tmp_path)
    assert tree.operations < report.operations


def test_compiled_library_is_callable_from_python(explicit_laws, tmp_path):
    if CC is None:
        pytest.skip("no C compiler")
    law = explicit_laws[0]
    law.to_c(tmp_path, name="pwa")
    subprocess.run([CC, "-shared", "-fPIC", "-O2", "pwa.c", "-o", "pwa.so"], cwd=tmp_path, check=True)
    call = ctypes.CDLL(str(tmp_path / "pwa.so")).pwa_law
    theta, u = (ctypes.c_double * 2)(3.0, -1.0), (ctypes.c_double * 1)()
    assert call(theta, u) == 0
    assert u[0] == pytest.approx(law([3.0, -1.0])[0], rel=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "1x"}, "name: got '1x', expected a C identifier"),
        ({"method": "hash"}, "method: got 'hash'"),
        ({"scalar": "half"}, "scalar: got 'half'"),
    ],
)
def test_unknown_options_are_refused(explicit_laws, options, message, tmp_path):
    with pytest.raises(InputError, match=message):
        explicit_laws[0].to_c(tmp_path, **options)


@needs_compiler
def test_leaves_with_several_laws_are_scanned(explicit_laws, tmp_path):
    law = explicit_laws[0]
    root = law.tree.nodes[0]
    coarse = np.array([[root[0], 1, 2], [-1, 0, len(law)], [-1, 0, len(law)]])
    whole = replace(law, tree=replace(law.tree, nodes=coarse, leaf_regions=np.arange(len(law))))
    whole.to_c(tmp_path)
    theta = np.random.default_rng(1).uniform(-6, 6, size=(5000, 2))
    u, outside = law.evaluate(theta)
    out = run_c(tmp_path, theta, "double").reshape(-1, 2)
    np.testing.assert_array_equal(out[:, 1], outside)
    np.testing.assert_allclose(out[:, :1], u, atol=1e-9)


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize("size", [1.5, 1e3, 1e300])
def test_both_methods_and_python_agree_outside(explicit_laws, size, tmp_path):
    law = explicit_laws[1]
    p = law.partition
    theta = p.centre + size * p.half * np.random.default_rng(2).uniform(-1, 1, size=(2000, law.nt))
    u, outside = law.evaluate(theta)
    assert outside.mean() > 0.5
    for method in ("tree", "sequential"):
        law.to_c(tmp_path / method, method=method)
        out = run_c(tmp_path / method, theta, "double").reshape(-1, law.nu + 1)
        np.testing.assert_array_equal(out[:, -1], outside)
        np.testing.assert_allclose(out[:, :-1], u, atol=1e-6 * np.abs(law.input_rows[1]).max())


def test_a_folder_that_cannot_be_written_to_is_refused(explicit_laws, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"folder: got .* expected a folder that can be written to"):
        explicit_laws[0].to_c(tmp_path / "file")


def test_a_tree_of_an_incomplete_partition_is_refused(tmp_path):
    A, B = double_integrator()
    law = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=5, X=box([5, 5]), U=box([1])).explicit(max_regions=7)
    with pytest.raises(InputError, match=r"method: got 'tree' for a partition that is incomplete \(REGION_LIMIT\)"):
        law.to_c(tmp_path)
    assert law.to_c(tmp_path, method="sequential").regions == 7
