"""The same answer on 1 to 4 ranks, and for 4, 16 and 64 subdomains; hangs end."""

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


def test_numbers_of_subdomains_do_not_matter(serial_only, solved):
    few, some, many = (solved(2, f"pair-tetrahedron-{n}") for n in (4, 16, 64))
    for other in (some, many):
        assert relative(other["u"], few["u"]) <= 1e-6


def test_more_ranks_than_subdomains(serial_only, solved):
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
