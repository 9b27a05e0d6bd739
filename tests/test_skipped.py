"""What a scene does not need is not made: counters of the report."""

import sys
from pathlib import Path

import numpy as np
import pytest
import ufl
from bodies import clamped, no_load, two_body_problem
from quick_demos import process
from scenes import curved_obstacle, decomposed, problem, solved

import tfeti_dolfinx as tfeti

SUBDOMAINS = 8


@pytest.mark.parametrize(
    ("contact", "qp_type", "pc_type", "factors"),
    [
        (False, "pcpg", "none", 1),
        (False, "pcpg", "dirichlet", 2),
        (True, "smalse", "auto", 1),
        (True, "newton", "lumped", 1),
        (True, "newton", "dirichlet", 2),
    ],
)
def test_only_the_dirichlet_preconditioner_factors_K_ii(contact, qp_type, pc_type, factors):
    """Of equal subdomains that do not share their factors."""
    obstacles = [tfeti.Obstacle("bottom", curved_obstacle(3))] if contact else []
    options = {"local_type": "implicit", "qp_type": qp_type, "pc_type": pc_type}
    p = solved(problem(decomposed("hexahedron", 4, SUBDOMAINS), contacts=obstacles, **options))
    assert p.report.factorizations == factors * SUBDOMAINS
    assert (p.report.preconditioner_multiplications == 0) == (pc_type in ("none", "auto"))
    p.solve()
    assert p.report.F_multiplications + p.report.power_method_multiplications <= 2
    assert p.report.preconditioner_multiplications == 0
    assert p.report.factorizations == p.report.coarse_factorizations == 0


@pytest.mark.parametrize("qp_type", ["pcpg", "smalse", "newton"])
def test_without_a_kernel_there_is_no_coarse_problem(qp_type):
    obstacles = [tfeti.Obstacle("bottom", curved_obstacle(3, 1e-3))] if qp_type != "pcpg" else []
    options = {"rtol": 1e-9, "qp_type": qp_type}
    d = decomposed("hexahedron", 3, 4)
    given = {"loaded": "bottom", "clamped": (), "springs": 100.0}
    p = solved(problem(d, (0.0, 0.0, -9.0), obstacles, **given, **options))
    assert p.report.kernel_dim == p.report.coarse_factorizations == 0
    assert p.report.face_factorizations == 0
    assert p.report.soft_modes == 0
    assert (p.report.preconditioner_multiplications > 0) == (qp_type != "smalse")
    assert p.report.F_multiplications > 0
    assert (p.report.active_contacts > 0) == (qp_type != "pcpg")


LOADS = {
    "none": no_load,
    "stress": lambda v, ds: 0.02 * ufl.div(v) * ufl.dx,
    "weight": lambda v, ds: -0.05 * v[2] * ufl.dx,
}


@pytest.mark.parametrize(
    ("load", "qp_type"), [("none", "newton"), ("stress", "pcpg"), ("weight", "newton")]
)
def test_without_a_force_on_a_subdomain_F_is_not_applied_at_the_start(load, qp_type):
    """e = 0 also where a given stress balances itself."""
    d = decomposed("hexahedron", 4, 8)
    down = np.array((0.0, 0.0, -0.01 if load == "none" else 0.0))
    far = [tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -1), (0, 0, 1)), reach=2.0)]
    given = LOADS[load], clamped(d, "left", ("right", down)), far if qp_type == "newton" else []
    p = solved(two_body_problem(d, *given, qp_type=qp_type))
    moves = load == "weight"
    assert np.any(p.dual.coarse.e) == moves
    assert p.report.cg_steps > 0
    assert p.report.F_multiplications == p.report.cg_steps + moves


HEAVY = """
import sys
from pathlib import Path
sys.path.insert(0, "tests")
from scenes import curved_obstacle, decomposed, problem
import tfeti_dolfinx as tfeti
from tfeti_dolfinx.io.output import write_vtx
p = problem(decomposed("triangle", 3, 2), contacts=[tfeti.Obstacle("bottom", curved_obstacle(2))])
p.solve()
write_vtx(Path(sys.argv[1]) / "u.bp", p.solution)
heavy = ("gmsh", "pyvista", "vtkmodules", "matplotlib", "slepc4py")
print(*[name for name in heavy if name in sys.modules])
"""


def test_a_scene_that_draws_nothing_imports_nothing_that_draws(serial_only, tmp_path):
    """From the import to the file of results."""
    root = Path(__file__).resolve().parents[1]
    assert process([sys.executable, "-c", HEAVY, tmp_path], root).split() == []
