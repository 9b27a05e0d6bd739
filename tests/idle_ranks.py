"""Demos on more ranks than subdomains: run by test_ranks, not collected."""

import numpy as np
import pytest
from mpi4py import MPI

import demos
from tfeti_dolfinx.mesh import tearing


# two bodies at most; the others of the demos have more than there are ranks here
@pytest.mark.parametrize("name", ["linear_3d", "cylinder_on_block_2d", "adaptive_2d"])
def test_demos(name, comm, shared_tmp, monkeypatch):
    """Every subdomain that a demo asks for becomes one, or one for each body; one draws contact."""

    def few(mesh, *_):
        return np.zeros(len(mesh.cells), dtype=np.int64)

    for name_of_maker in ("make_parts", "given_subdomains"):
        monkeypatch.setattr(tearing, name_of_maker, few)
    report_file, folder = shared_tmp / "report.json", shared_tmp / "out"
    outputs = ["--report", report_file, "--output", folder]
    outputs += ["--plot"] * (name == "cylinder_on_block_2d")
    solution, _ = demos.run(name, ["--quick", *outputs])
    assert comm.allreduce(len(solution.decomposition.subdomains), op=MPI.MIN) == 0
    comm.barrier()
    assert report_file.is_file()
