"""The same answer on 1 to 4 ranks, for few and many subdomains, and with idle ranks; hangs end."""

import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from scenes import relative

HERE = Path(__file__).resolve().parent


def run(ranks, *arguments, limit=300):
    start = ["mpirun", "-n", str(ranks)] if ranks > 1 else []
    command = [*start, sys.executable, *map(str, arguments)]
    return subprocess.run(command, cwd=HERE, capture_output=True, text=True, timeout=limit)


CASES = ["obstacle-triangle-6", "pair-hexahedron-6"]
ROUGH = ["rough-triangle-6"]
FEW = "obstacle-triangle-2"
# on how many ranks what is solved
STARTS = {
    1: [*CASES, *ROUGH, FEW],
    2: [*CASES, *ROUGH, *(f"pair-tetrahedron-{n}" for n in (4, 16, 64))],
    4: [*CASES, *ROUGH, FEW],
}


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """What so many ranks find in a case; they start once, in the first test that asks."""
    folders = {}

    def of(ranks, case):
        if ranks not in folders:
            folders[ranks] = tmp_path_factory.mktemp("ranks")
            result = run(ranks, "ranks_script.py", folders[ranks], 1e-10, *STARTS[ranks])
            assert result.returncode == 0, result.stderr
        return np.load(folders[ranks] / f"{case}.npz")

    return of


def test_numbers_of_subdomains_do_not_matter_nor_more_ranks_than_these(serial_only, solved):
    few, some, many = (solved(2, f"pair-tetrahedron-{n}") for n in (4, 16, 64))
    for other in (some, many):
        assert relative(other["u"], few["u"]) <= 1e-6
    one, four = solved(1, FEW), solved(4, FEW)
    assert min(one["late"], four["late"]) > 0
    assert relative(four["u"], one["u"]) <= 1e-8


@pytest.mark.parametrize("case", CASES)
def test_ranks_do_not_matter(serial_only, solved, case):
    """Of the final faces as well, but for rows whose force and gap are both nearly 0."""
    one, *others = (solved(ranks, case) for ranks in (1, 2, 4))
    assert one["active"] > 0
    most, deepest = one["force"].max(), np.abs(one["u"]).max()
    for other in others:
        assert np.allclose(one["x"], other["x"])
        assert relative(other["u"], one["u"]) <= 1e-8
        assert np.allclose(other["force"], one["force"], rtol=0.0, atol=1e-6 * most)
        apart = (other["force"] > 0.0) != (one["force"] > 0.0)
        assert np.all(one["force"][apart] <= 1e-8 * most)
        assert np.all(np.abs(one["gap"][apart]) <= 1e-8 * deepest)


@pytest.mark.parametrize("case", ROUGH)
def test_ranks_do_not_matter_to_friction(serial_only, solved, case):
    one, *others = (solved(ranks, case) for ranks in (1, 2, 4))
    assert min(one["sticking"], one["sliding"]) > 0
    largest = np.abs(one["traction"]).max()
    for other in others:
        assert relative(other["u"], one["u"]) <= 1e-7
        assert np.allclose(other["traction"], one["traction"], rtol=0.0, atol=1e-6 * largest)
        assert (other["sticking"], other["sliding"]) == (one["sticking"], one["sliding"])


# inside mpi4py a rank waits without Python's lock, inside DOLFINx with it
HANGS = {
    "mpi4py": "MPI.COMM_WORLD.recv(source=1)",
    "DOLFINx": "mesh.create_unit_square(MPI.COMM_WORLD, 2, 2)",
}


@pytest.mark.parametrize("where", list(HANGS))
def test_a_test_that_hangs_on_one_rank_ends_on_all(serial_only, tmp_path, where):
    test = tmp_path / "test_hang.py"
    test.write_text(
        textwrap.dedent(f"""
            from dolfinx import mesh
            from mpi4py import MPI

            def test_hang():
                if MPI.COMM_WORLD.rank == 0:
                    {HANGS[where]}
        """)
    )
    start = time.monotonic()
    arguments = ["-m", "pytest", "-c", HERE.parent / "pyproject.toml", "-p", "conftest"]
    result = run(2, *arguments, "--timeout=2", test)
    assert result.returncode != 0
    assert time.monotonic() - start < 60
    assert "Timeout" in result.stdout + result.stderr


# a rank without a subdomain has empty arrays everywhere, yet takes part in every collective call
OF_TWO_SUBDOMAINS = [
    "idle_ranks.py",
    "test_output.py",
    "test_gmsh.py::test_files_with_and_without_partitions",
    "test_gmsh.py::test_a_surface_between_partitions_is_tagged_on_both_sides",
    "test_unloading.py::test_a_body_at_rest_behind_an_open_gap_does_not_limit_that_either",
    "test_solvability.py::test_a_load_that_turns_is_looked_at_again_and_one_that_grows_is_not",
    "test_nonlinear.py::test_a_tangent_of_another_problem_is_named",
    "test_mistakes.py::test_mistakes_are_named[contacts shapes]",
    "test_mistakes.py::test_mistakes_are_named[conditions bcs]",
    "test_mistakes.py::test_mistakes_are_named[boundary solved]",
]


def test_ranks_without_a_subdomain(serial_only):
    """On three ranks, files of one kind of cells; a case that hangs ends all. A demo draws."""
    left = "not pictures and not cut and not tetrahedron"
    options = ("-m", "pytest", "--timeout=100", "-k", left)
    result = run(3, *options, *OF_TWO_SUBDOMAINS, limit=500)
    assert result.returncode == 0, result.stdout[-6000:] + result.stderr[-3000:]
