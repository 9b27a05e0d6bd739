"""What a scene does not need is not made: counters of the report."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import ufl
from bodies import boxes
from dolfinx import fem
from scenes import clamp, curved_obstacle, decomposed, hooke, problem, strain

import tfeti_dolfinx as tfeti

SUBDOMAINS = 8


def cube(contact, **options):
    """A clamped cube of equal subdomains that do not share their factors."""
    obstacles = [tfeti.Obstacle("bottom", curved_obstacle(3))] if contact else []
    d = decomposed("hexahedron", 4, SUBDOMAINS)
    return problem(d, contacts=obstacles, tfeti_local_type="implicit", **options)


@pytest.mark.parametrize(
    ("contact", "qp_type", "pc_type", "factors"),
    [
        (False, "pcpg", "none", 1),
        (False, "pcpg", "lumped", 1),
        (False, "pcpg", "dirichlet", 2),
        (True, "smalse", "auto", 1),
        (True, "newton", "none", 1),
        (True, "newton", "lumped", 1),
        (True, "newton", "dirichlet", 2),
    ],
)
def test_only_the_dirichlet_preconditioner_factors_K_ii(contact, qp_type, pc_type, factors):
    p = cube(contact, tfeti_qp_type=qp_type, tfeti_pc_type=pc_type)
    p.solve()
    assert p.report.factorizations == factors * SUBDOMAINS
    assert (p.report.preconditioner_multiplications == 0) == (pc_type in ("none", "auto"))
    p.destroy()


@pytest.mark.parametrize(
    ("contact", "options"),
    [
        (False, {"pc_type": "none"}),
        (False, {"pc_type": "dirichlet"}),
        (True, {"qp_type": "smalse"}),
        (True, {"qp_type": "newton", "pc_type": "lumped"}),
        (True, {"qp_type": "newton", "kplus_type": "schur"}),
    ],
)
def test_the_same_load_again_makes_no_factor(contact, options):
    p = cube(contact, **options)
    p.solve()
    p.solve()
    assert p.report.F_multiplications + p.report.power_method_multiplications <= 2
    assert p.report.preconditioner_multiplications == 0
    assert p.report.factorizations == p.report.coarse_factorizations == 0
    p.destroy()


@pytest.mark.parametrize("contact", [False, True])
def test_a_subdomain_without_interface_has_no_inside(contact):
    """Beside a box of several subdomains, one that springs hold, and that no row touches."""
    parts = [("held", (0, 0, 0), (1, 1, 1), (3, 3, 3)), ("loose", (3, 0, 0), (4, 1, 1), (2, 2, 2))]
    mesh, facet_tags, names = boxes("hexahedron", parts)
    d = tfeti.decompose(
        mesh,
        lambda x: np.where(x[0] > 2, 2, (x[2] > 0.5).astype(int)),
        facet_tags=facet_tags,
        surfaces=names,
    )
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    x = ufl.SpatialCoordinate(d.mesh)
    springs = ufl.conditional(ufl.gt(x[0], 2.0), 1.0, 0.0)
    a = (ufl.inner(hooke()(u), strain(v)) + springs * ufl.inner(u, v)) * ufl.dx
    L = -0.05 * v[2] * ufl.dx
    obstacles = [tfeti.Obstacle("held bottom", curved_obstacle(3))] if contact else []
    options = {"qp_type": "newton" if contact else "pcpg", "local_type": "implicit"}
    p = tfeti.ContactProblem(
        a, L, [clamp(V, d.facets("held left"))], obstacles, d, petsc_options=options
    )
    uh = p.solve()
    assert d.num_subdomains == 3
    assert p.report.factorizations == 3 + 2
    assert p.report.preconditioner_multiplications > 0
    assert sum(n for form, n in p.report.local_operators.items() if form == "F_implicit") == 2
    loose = V.tabulate_dof_coordinates()[:, 0] > 2
    assert np.allclose(uh.x.array.reshape(-1, 3)[loose], (0, 0, -0.05), atol=1e-9)
    p.destroy()


@pytest.mark.parametrize("qp_type", ["pcpg", "smalse", "newton"])
def test_without_a_kernel_there_is_no_coarse_problem(qp_type):
    d = decomposed("hexahedron", 3, 4)
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = (ufl.inner(hooke()(u), strain(v)) + 0.1 * ufl.inner(u, v)) * ufl.dx
    obstacles = [tfeti.Obstacle("bottom", curved_obstacle(3))] if qp_type != "pcpg" else []
    options = {"rtol": 1e-9, "qp_type": qp_type}
    p = tfeti.ContactProblem(a, -0.1 * v[2] * ufl.dx, [], obstacles, d, petsc_options=options)
    p.solve()
    assert p.report.kernel_dim == p.report.coarse_factorizations == 0
    assert p.report.face_factorizations == 0
    preconditioned = p.report.preconditioner_multiplications > 0
    assert (p.report.soft_factorizations > 0) == preconditioned == (qp_type != "smalse")
    assert p.report.F_multiplications > 0
    assert (p.report.active_contacts > 0) == (qp_type != "pcpg")
    p.destroy()


LOADS = {
    "none": lambda v: ufl.ZeroBaseForm((v,)),
    "stress": lambda v: 0.02 * ufl.div(v) * ufl.dx,
    "weight": lambda v: -0.05 * v[2] * ufl.dx,
}


@pytest.mark.parametrize("load", list(LOADS))
@pytest.mark.parametrize("qp_type", ["pcpg", "newton"])
def test_without_a_force_on_a_subdomain_F_is_not_applied_at_the_start(load, qp_type):
    """e = 0 also where a given stress balances itself."""
    d = decomposed("hexahedron", 4, 8)
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dofs = fem.locate_dofs_topological(V, 2, d.facets("left"))
    down = np.array((0.0, 0.0, -0.01 if load == "none" else 0.0))
    top = fem.locate_dofs_topological(V, 2, d.facets("right"))
    bcs = [fem.dirichletbc(np.zeros(3), dofs, V), fem.dirichletbc(down, top, V)]
    far = [tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -1), (0, 0, 1)), reach=2.0)]
    contacts = far if qp_type == "newton" else []
    a = ufl.inner(hooke()(u), strain(v)) * ufl.dx
    options = {"qp_type": qp_type}
    p = tfeti.ContactProblem(a, LOADS[load](v), bcs, contacts, d, petsc_options=options)
    p.solve()
    moves = load == "weight"
    assert np.any(p.dual.coarse.e) == moves
    assert p.report.cg_steps > 0
    assert p.report.F_multiplications == p.report.cg_steps + moves
    p.destroy()


HEAVY = """
import sys
from pathlib import Path
sys.path.insert(0, "tests")
from scenes import curved_obstacle, decomposed, problem
import tfeti_dolfinx as tfeti
from tfeti_dolfinx.output import write_vtx
p = problem(decomposed("triangle", 3, 2), contacts=[tfeti.Obstacle("bottom", curved_obstacle(2))])
p.solve()
write_vtx(Path(sys.argv[1]) / "u.bp", p.solution)
heavy = ("gmsh", "pyvista", "vtkmodules", "matplotlib", "slepc4py")
print(*[name for name in heavy if name in sys.modules])
"""


def test_a_scene_that_draws_nothing_imports_nothing_that_draws(serial_only, tmp_path):
    """From the import to the file of results."""
    result = subprocess.run(
        [sys.executable, "-c", HEAVY, str(tmp_path)],
        cwd=Path(__file__).resolve().parents[1],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []
