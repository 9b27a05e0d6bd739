"""Extreme eigenvalues of B Bᵀ and B D⁻¹ Bᵀ: right, and bounded whatever h and H are."""

import json

import numpy as np
import pytest
from bodies import held, pressed, sided, stacked, stiffer_above, two_body_problem
from dolfinx import fem
from mpi4py import MPI
from scenes import decomposed, problem
from scipy.sparse import csr_array

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.constraints import spectrum as module
from tfeti_dolfinx.constraints.gluing import glue, prescribe
from tfeti_dolfinx.contact.records import concatenate
from tfeti_dolfinx.errors import ConvergenceError, InputError
from tfeti_dolfinx.mesh.dofs import TornDofs

# the rows alone matter: no step of the solver is made
ROWS_ONLY = dict(max_it=0, norm_steps=1, error_if_not_converged=False)
SCALINGS = ["multiplicity", "stiffness"]
UP, DOWN = ("upper bottom", "lower top"), ("lower top", "upper bottom")  # secondary, primary


def stacked_problem(cell, n, subdomains, scaling, pair=UP, stiffness=1.0, **options):
    """A box on a box, n = (cells of the lower, cells of the upper), the upper one stiffer."""
    d = stacked(cell, *n, subdomains)
    gdim = d.mesh.geometry.dim
    sides = ["lower bottom", "lower left", "upper left"]
    sides += ["lower front", "upper front"] if gdim == 3 else []
    return two_body_problem(
        d,
        pressed(d),
        held(d, *sides),
        [sided(*pair)],
        stress=stiffer_above(d, stiffness),
        scaling=scaling,
        **options,
    )


def spectrum(*args, **kwargs):
    p = stacked_problem(*args, **kwargs, spectrum=True, **ROWS_ONLY)
    p.solve()
    p.destroy()
    return p.report.spectrum


def dense(constraints):
    """The same four numbers from a dense matrix, gathered."""
    comm = MPI.COMM_WORLD
    indptr, indices, data = constraints.B.getValuesCSR()
    shape = (len(indptr) - 1, constraints.B.getSize()[1])
    rows = comm.allgather(csr_array((data, indices, indptr), shape=shape).toarray())
    B, D = np.concatenate(rows), np.concatenate(comm.allgather(constraints.weights))
    values = [np.linalg.eigvalsh(A)[[0, -1]] for A in (B @ B.T, B / D @ B.T)]
    return np.concatenate(values)


def assert_within(found, low, high, of):
    assert len(found) == 3
    for values in found:
        assert low <= values[f"{of}_min"] <= values[f"{of}_max"] <= high


@pytest.mark.parametrize("scaling", SCALINGS)
@pytest.mark.parametrize("stiffness", [1.0, 1e3])
@pytest.mark.parametrize("cell", ["quadrilateral", "triangle", "hexahedron", "tetrahedron"])
def test_values_are_those_of_the_dense_matrix(cell, stiffness, scaling):
    n = (6, 8) if cell in ("quadrilateral", "triangle") else (2, 3)
    p = stacked_problem(cell, n, 8, scaling, stiffness=stiffness, spectrum=True, **ROWS_ONLY)
    p.solve()
    assert list(p.report.spectrum) == ["BBt_min", "BBt_max", "BDBt_min", "BDBt_max"]
    assert np.allclose(list(p.report.spectrum.values()), dense(p.dual.constraints), rtol=1e-8)


def test_values_do_not_depend_on_the_number_of_ranks():
    """Figures of a serial run."""
    found = spectrum("quadrilateral", (6, 8), 4, "stiffness")
    expected = [0.95676735574096, 2.67930239126265, 0.58856408133770, 1.34760511192143]
    assert np.allclose(list(found.values()), expected, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize(
    "scenes",
    [
        [((3 * k, 4 * k), 4) for k in (2, 4, 8)],
        [((12, 16), subdomains) for subdomains in (2, 8, 32)],
        [((3, 4), 2), ((6, 8), 8), ((12, 16), 32)],
    ],
    ids=["h", "H", "H/h fixed"],
)
def test_bounds_in_2d(scenes):
    by_copies = [spectrum("quadrilateral", *scene, "multiplicity") for scene in scenes]
    assert_within(by_copies, 0.55, 1.4, of="BBt")
    by_stiffness = [spectrum("quadrilateral", *scene, "stiffness") for scene in scenes]
    assert_within(by_stiffness, 0.55, 1.4, of="BDBt")
    # D is bounded on meshes of equal cells, so B Bᵀ is too
    assert_within(by_stiffness, 0.85, 2.8, of="BBt")


@pytest.mark.parametrize(
    "scenes",
    [
        [((2 * k, 3 * k), 4) for k in (1, 2, 4)],
        [((4, 6), subdomains) for subdomains in (4, 8, 16)],
    ],
    ids=["h", "H"],
)
def test_bounds_in_3d(scenes):
    by_copies = [spectrum("hexahedron", *scene, "multiplicity") for scene in scenes]
    assert_within(by_copies, 0.38, 2.2, of="BBt")
    by_stiffness = [spectrum("hexahedron", *scene, "stiffness") for scene in scenes]
    assert_within(by_stiffness, 0.6, 1.9, of="BDBt")
    assert_within(by_stiffness, 0.85, 9.5, of="BBt")


def test_without_D_the_two_are_the_same():
    found = spectrum("triangle", (6, 8), 8, "multiplicity")
    assert found["BDBt_min"] == pytest.approx(found["BBt_min"], rel=1e-9)
    assert found["BDBt_max"] == pytest.approx(found["BBt_max"], rel=1e-9)


def test_a_jump_of_stiffness_leaves_only_one_of_them_bounded():
    """Secondary is the softer body: B D⁻¹ Bᵀ is bounded, B Bᵀ grows with D."""
    jumps = (1.0, 1e3, 1e6)
    scene = ("quadrilateral", (6, 8), 8)
    scaled = [spectrum(*scene, "stiffness", DOWN, jump) for jump in jumps]
    assert_within(scaled, 0.95, 1.1, of="BDBt")
    assert [s["BBt_max"] >= jump for s, jump in zip(scaled, jumps, strict=True)] == [True] * 3
    by_copies = [spectrum(*scene, "multiplicity", DOWN, jump) for jump in jumps]
    assert_within(by_copies, 0.95, 1.1, of="BBt")


def test_a_stiff_and_fine_secondary_has_nearly_dependent_rows():
    """In D⁻¹ its rows live on the primary side, which has fewer nodes than there are rows."""
    values = [spectrum("quadrilateral", (6, 8), 8, "stiffness", UP, E) for E in (1.0, 1e3, 1e6)]
    smallest = [v["BDBt_min"] for v in values]
    assert smallest[0] > 0.55
    assert 1e-4 < smallest[1] < 1e-2
    assert 1e-7 < smallest[2] < 1e-5


@pytest.mark.parametrize("scaling", SCALINGS)
def test_bounds_need_meshes_of_comparable_size(scaling):
    """Many secondary nodes on one primary node: the largest eigenvalue grows with their number."""
    ratios = (4, 8, 16)
    fine = [spectrum("quadrilateral", (2, 2 * r), 2, scaling, UP)["BDBt_max"] for r in ratios]
    assert fine[2] > 1.5 * fine[1] > 2.25 * fine[0]
    coarse = [spectrum("quadrilateral", (2, 2 * r), 2, scaling, DOWN) for r in ratios]
    assert_within(coarse, 0.8, 1.2, of="BDBt")


def test_two_equal_conditions_are_seen():
    """Two obstacles at the same plane: the smallest eigenvalue is 0, and is found."""
    twice = [tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -0.01), (0, 0, 1)))] * 2
    p = problem(decomposed("hexahedron", 3, 4), contacts=twice, spectrum=True, **ROWS_ONLY)
    p.solve()
    assert 0.0 <= p.report.spectrum["BDBt_min"] < 1e-9
    assert p.report.spectrum["BDBt_max"] == pytest.approx(2.0)


def test_no_rows_no_values():
    d = decomposed("triangle", 2, 1)
    dofs = TornDofs(fem.functionspace(d.mesh, ("Lagrange", 1, (2,))), d)
    ones = np.ones(dofs.num_nodes * dofs.bs)
    constraints = glue(dofs, prescribe(dofs, []), concatenate([], 2), 1.0, ones).constraints
    assert module.extreme_eigenvalues(constraints) == {}
    constraints.destroy()


def test_the_report_has_them_when_asked():
    p = problem(decomposed("triangle", 3, 2), tfeti_spectrum=True)
    p.solve()
    assert p.report.converged_reason == "CONVERGED_RTOL"
    assert json.loads(p.report.to_json())["spectrum"] == p.report.spectrum
    for name in ("BBt_min", "BBt_max", "BDBt_min", "BDBt_max"):
        assert p.report.spectrum[name] > 0.0
        assert f"spectrum.{name}" in str(p.report)
    assert p.report.seconds["spectrum"] > 0.0


def no_slepc():
    raise ImportError("No module named 'slepc4py'")


def test_without_the_option_it_costs_nothing(monkeypatch):
    monkeypatch.setattr(module, "_slepc", no_slepc)
    p = problem(decomposed("triangle", 3, 2))
    p.solve()
    assert p.report.spectrum == {}
    assert json.loads(p.report.to_json())["spectrum"] == {}
    assert "BBt" not in str(p.report)
    assert "spectrum" not in p.report.seconds


def test_slepc_is_missed_at_once(monkeypatch):
    monkeypatch.setattr(module, "_slepc", no_slepc)
    with pytest.raises(InputError, match=r"option spectrum needs slepc4py, .*No module named"):
        problem(decomposed("triangle", 2, 2), spectrum=True)


def test_no_convergence_is_an_error(monkeypatch):
    monkeypatch.setattr(module, "TOLERANCE", 1e-300)
    monkeypatch.setattr(module, "MAX_RESTARTS", 1)
    with pytest.raises(ConvergenceError, match="extreme eigenvalue of B Bᵀ was not found in 1"):
        spectrum("triangle", (6, 8), 8, "stiffness")
