"""Subdomains with boundary elements: their matrices, loads, and scenes with finite elements."""

import dolfinx
import numpy as np
import pytest
import ufl
from bodies import clamped, drawn, held, no_load, pressed, two_body_problem
from dolfinx import fem
from dolfinx import mesh as dmesh
from panels import kelvin
from scenes import SIDES, box, curved_obstacle, decomposed, displacement, forms, relative, solved

import tfeti_dolfinx as tfeti
from demos import run
from tfeti_dolfinx.bem.block import Parts
from tfeti_dolfinx.bem.steklov import IsotropicLaw
from tfeti_dolfinx.common.arrays import node_blocks
from tfeti_dolfinx.common.compat import assemble_csr
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.subdomains import subdomain_data
from tfeti_dolfinx.testing import check_block

ALL = tfeti.BoundaryElements()


@pytest.mark.parametrize(("cell", "n"), [("triangle", 6), ("hexahedron", 2)])
def test_blocks_keep_their_promises(cell, n):
    d = decomposed(cell, n, 2)
    V, a, _ = forms(d.mesh, d.facet_tags, (0.0,) * d.mesh.geometry.dim, d.surface("top"))
    dofs, K = TornDofs(V, d), assemble_csr(fem.form(a))
    parts = Parts(dofs, d, np.ones(len(d.subdomains), dtype=bool), InverseFactory())
    parts.take_stiffness(K, node_blocks(K, dofs.bs)[dofs.dolfinx_node])
    trace = np.concatenate(
        [np.empty(0, dtype=np.int64)]
        + [parts._unknowns(s).start + np.flatnonzero(p.on_surface) for s, p in parts.parts.items()]
    )
    data = subdomain_data(dofs, K, np.zeros(dofs.num_nodes * dofs.bs), trace)
    for block, part in zip(map(parts.blocks(None), data), parts.parts.values(), strict=True):
        check_block(block, part.shape.K[part.place][:, part.place])


@pytest.mark.parametrize(
    ("cell", "sizes", "qp_type"),
    [
        ("quadrilateral", (6, 12), "smalse"),
        pytest.param("hexahedron", (3, 6), "newton", marks=pytest.mark.slow),
    ],
)
def test_a_scene_of_both_kinds_of_elements_has_one_limit(cell, sizes, qp_type):
    gdim, difference = 3 if cell == "hexahedron" else 2, []
    floor = tfeti.Obstacle("bottom", curved_obstacle(gdim))
    for n in sizes:
        found = []
        for elements in (None, ALL):
            d = decomposed(cell, n, 4)
            given = pressed(d, 0.05, "top"), clamped(d, "left"), [floor]
            options = {"qp_type": qp_type, "rtol": 1e-9}
            p = solved(two_body_problem(d, *given, elements=elements, **options))
            found.append(displacement(p)[1][:, -1].min())
        difference.append(found[0] / found[1])
    assert 0.95 < difference[0] < difference[1] < 1.0  # softer
    assert 1.0 - difference[1] < 0.75 * (1.0 - difference[0])


STRETCH = np.array([0.1, -0.1 * 0.3 / 0.7])


def tension(d, elements, t=None):
    """Two volumes under uniaxial tension, solved; given t, it can be changed afterwards."""
    load = drawn(d, "right", (0.1 / (1 - 0.3**2), 0.0) if t is None else t)
    bcs = held(d, "left", "bottom")
    return solved(two_body_problem(d, load, bcs, [], elements=elements, rtol=1e-10))


def test_constant_stresses_are_exact_in_space():
    """The mean of both ways to cut the facets of hexahedra loads corners as they do."""
    d = two_volumes("hexahedron", 2)
    given = drawn(d, "top", (0.0, 0.0, 0.1)), held(d, "left", "front", "bottom"), []
    for elements in (tfeti.BoundaryElements("low"), ALL):
        p = solved(two_body_problem(d, *given, elements=elements))
        x, u = displacement(p)
        assert np.abs(u - x * (-0.03, -0.03, 0.1)).max() < 1e-6
        values = p.solution.at([(0.4, 0.3, 0.2)])
        assert np.abs(values.displacement - (-0.012, -0.009, 0.02)).max() < 1e-6
        (_, stress), _ = cells_and_nodes(p.solution.interior, d)
        assert np.abs(stress - np.diag((0.0, 0.0, 0.1))).max(initial=0.0) < 1e-6


def two_volumes(cell="triangle", n=4):
    """A square or cube of two volumes, each two subdomains."""
    mesh, facet_tags, names = box(cell, n)
    up = mesh.topology.dim - 1
    return tfeti.decompose(
        mesh,
        lambda x: (x[0] > 0.5) + 2 * (x[up] > 0.5),
        facet_tags=facet_tags,
        volumes={"low": lambda x: x[up] <= 0.5, "high": lambda x: x[up] >= 0.5},
        surfaces=names,
    )


def test_a_force_per_volume():
    """Beside a fine solution; of cells that meet on the surface none decides on the stress."""
    found = []
    for n, elements, side in ((4, None, 0.02), (4, ALL, 0.02), (16, None, 0.02), (4, ALL, 0.0)):
        d = decomposed("quadrilateral", n, 4)
        given = drawn(d, None, (side, -0.1)), clamped(d, "bottom"), []
        p = solved(two_body_problem(d, *given, elements=elements, rtol=1e-9))
        x, u = displacement(p)
        found.append(u[np.all(np.isclose(x * 4, np.rint(x * 4)), axis=1)])
    assert relative(found[1], found[2]) < 0.6 * relative(found[0], found[2]) < 0.1
    left, right = p.solution.at([(0.25, 1.0), (0.75, 1.0)]).stress
    assert np.abs(left - right * [(1, -1), (-1, 1)]).max() < 1e-9


def size(d, values):
    return np.sqrt(d.comm.allreduce(float(np.sum(values**2))))


def cells_and_nodes(interior, d):
    """Midpoints of cells with stresses, nodes with displacements."""
    gdim = d.mesh.geometry.dim
    count = d.mesh.topology.index_map(gdim).size_local
    middle = dmesh.compute_midpoints(d.mesh, gdim, np.arange(count, dtype=np.int32))
    place = np.asarray(interior.stress.function_space.dofmap.list)[:, 0]
    stress = interior.stress.x.array.reshape(-1, 3, 3)[place]
    x = interior.displacement.function_space.tabulate_dof_coordinates()
    u = interior.displacement.x.array.reshape(-1, gdim)
    return (middle[:, :gdim], stress), (x[:, :gdim], u)


@pytest.mark.parametrize("elements", [None, tfeti.BoundaryElements("low"), ALL])
def test_constant_stresses_are_exact_everywhere(elements):
    """At nodes and points inside, on sides, corners and tears, and in fields on the mesh."""
    d, t = two_volumes(), 0.1 / (1 - 0.3**2)
    p = tension(d, elements)
    x, u = displacement(p)
    assert np.abs(u - x[:, :2] * STRETCH).max() < 1e-8
    points = [(0.3, 0.2), (0.7, 0.3), (0.2, 0.9), (0.71, 0.77), (0.3, 0.0), (0, 0), (0.5, 0.3)]
    points = np.array([*points, (0.5, 0.5), (0.7, 0.5), (1, 1), (0.5, 0.25), (1.5, 0.5)])
    values = p.solution.at(points)
    assert np.all(np.isnan(values.displacement[-1]))  # in no body
    assert np.abs(values.displacement - points * STRETCH)[:-1].max() < 1e-8
    assert np.abs(values.stress - np.diag([t, 0.0]))[:-1].max() < 1e-7
    (_, stress), (x, u) = cells_and_nodes(p.solution.interior, d)
    assert np.abs(u - x * STRETCH).max() < 1e-8
    assert np.abs(stress - np.diag([t, 0.0, 0.3 * t])).max(initial=0.0) < 1e-8
    mises = p.solution.interior.von_mises.x.array
    assert np.abs(mises - t * np.sqrt(1 - 0.3 + 0.3**2)).max(initial=0.0) < 1e-8


@pytest.mark.skipif(not dolfinx.has_adios2, reason="DOLFINx without ADIOS2")
def test_fields_inside_in_each_step_of_a_series(shared_tmp):
    """What the file gets is what the checkpoint keeps, at the times of the steps."""
    d, full = two_volumes(), 0.1 / (1 - 0.3**2)
    t = fem.Constant(d.mesh, (full, 0.0))
    p = tension(d, tfeti.BoundaryElements("low"), t)
    path, folder = shared_tmp / "inside" / "series.bp", shared_tmp / "inside" / "checkpoint"

    def apply(problem, time):
        t.value[0] = time * full

    def series(times, resume=False, **keywords):
        steps = tfeti.LoadSteps(p, apply, times, path=path, checkpoint=folder, **keywords)
        return steps.run(resume=resume)

    series([0.5, 1.0], interior=True)
    for number, time in ((1, 0.5), (2, 1.0)):
        with np.load(folder / f"fields_{number}_{d.comm.rank}.npz") as fields:
            stress = fields["interior_stress"].reshape(-1, 3, 3)
            assert np.abs(stress - time * np.diag([full, 0.0, 0.3 * full])).max(initial=0.0) < 1e-8
            assert {"interior_displacement", "interior_von_mises"} <= set(fields)
    series([0.5, 1.0, 1.5], resume=True, interior=True)
    for name in ("series.bp", "series_cells.bp"):
        assert (path.parent / name / "md.idx").stat().st_size == 64 * (1 + 3)
    assert not list(path.parent.glob(".*"))
    series([0.5, 1.0])
    with pytest.raises(tfeti.InputError, match="checkpoint has no field interior_displacement"):
        series([0.5, 1.0, 1.5], resume=True, interior=True)


@pytest.mark.parametrize(
    ("cell", "sizes"),
    [("triangle", (8, 16)), pytest.param("hexahedron", (3, 6), marks=pytest.mark.slow)],
)
def test_fields_inside_of_a_point_force_outside(cell, sizes):
    """Kelvin's solution: at nodes, and also in the cells that lie on the surface."""
    law, errors = IsotropicLaw(0.5 / 1.3, 0.3), []
    for n in sizes:
        d = decomposed(cell, n, 2)
        gdim = d.mesh.geometry.dim
        source = np.array([1.6, 0.7, 0.6])[:gdim]
        given = fem.Function(fem.functionspace(d.mesh, ("Lagrange", 1, (gdim,))))
        given.interpolate(lambda x, k=gdim, s=source: kelvin(x[:k].T, s, law)[0].T)
        bcs = clamped(d, *((name, given) for name in SIDES[gdim]))
        p = solved(two_body_problem(d, no_load, bcs, [], elements=ALL))
        (middle, stress), (x, u) = cells_and_nodes(p.solution.interior, d)
        exact = law.stress(kelvin(middle, source, law)[1])
        off = np.all((x > 1e-9) & (x < 1 - 1e-9), axis=1)  # where nothing is prescribed
        x, u = x[off], u[off]
        pairs = ((u, kelvin(x, source, law)[0]), (stress[:, :gdim, :gdim], exact))
        errors.append([size(d, one - other) / size(d, other) for one, other in pairs])
        same = p.solution.at(np.concatenate(d.comm.allgather(middle))).stress
        found = np.concatenate(d.comm.allgather(stress))[:, :gdim, :gdim]
        assert np.abs(found - same).max() < 1e-12 * np.abs(same).max()
    slopes = np.log2(np.divide(*errors))
    assert np.all(slopes > 1.5), (errors, slopes)
    assert np.all(errors[1] < np.array((2e-3, 5e-3) if gdim == 2 else (1e-2, 6e-2))), errors


def test_a_change_of_modulus_and_of_load():
    """A second solve makes S anew where the form has changed, and only there."""
    d = decomposed("triangle", 6, 4)
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (2,)))
    elastic = tfeti.Elasticity(d, E=1.0, nu=0.3, model="plane_stress", thickness=0.1)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    force = fem.Constant(d.mesh, (0.0, -0.1))
    L = elastic.thickness * ufl.dot(force, v) * ufl.dx
    given = {"stress": elastic.stress, "thickness": elastic.thickness, "boundary_elements": ALL}
    bcs, options = clamped(d, "left")(V), {"tfeti_rtol": 1e-10}
    p = tfeti.ContactProblem(elastic.a(u, v), L, bcs, [], d, petsc_options=options, **given)
    first = p.solve().x.array.copy()
    elastic.E.value = 2.0
    assert np.allclose(p.solve().x.array, first / 2, atol=1e-9)
    force.value *= 4.0
    assert np.allclose(p.solve().x.array, 2 * first, atol=1e-8)
    assert np.all(np.isfinite(p.solution.at([(0.3, 0.6)]).stress))
    assert p.report.factorizations == 0


# the talk's multiplications for 8, 64 and 216 subdomains, and what block Newton may take
TALK = {8: 130, 64: 137, 216: 133}
NEWTON = 35
LARGE = [pytest.param(n, 9, marks=pytest.mark.slow) for n in TALK]


@pytest.mark.parametrize(("subdomains", "cells"), [(8, 4), *LARGE])
def test_the_table_of_the_talk(subdomains, cells):
    for qp_type, most in (("newton", NEWTON), ("smalse", TALK[subdomains])):
        sizes = ["--subdomains", str(subdomains), "--cells", str(cells)]
        _, report = run("tbeti_cube_3d", [*sizes, "-tfeti_qp_type", qp_type])
        assert report.converged_reason == "CONVERGED_RTOL"
        assert report.F_multiplications <= most
        assert report.primal_dofs == 3 * (6 * cells**2 + 2) * subdomains
        assert report.kernel_dim == 6 * subdomains


def test_hertz():
    """Whichever bodies have finite elements; without any, fewer unknowns for the same error."""
    sides = {"none": [], "block": ["--finite", "block"], "both": ["--finite", "cylinder", "block"]}
    reports = {name: run("tbeti_hertz_2d", given)[1] for name, given in sides.items()}
    for errors in (report.errors for report in reports.values()):
        assert abs(errors["half_width"]) < 0.01
        assert abs(errors["peak_pressure"]) < 0.01
        assert abs(errors["force"]) < 1e-8
        assert errors["pressure_l2"] < 0.01
    boundary, finite = reports["none"], reports["both"]
    assert boundary.errors["pressure_l2"] < finite.errors["pressure_l2"]
    assert boundary.errors["stress_below"] < 1e-3 < finite.errors["stress_below"]
    assert 15 * boundary.primal_dofs < finite.primal_dofs
