"""Blocks: generalised inverses, kernels, Schur complements."""

from types import SimpleNamespace

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from petsc4py import PETSc
from scenes import clamp, decomposed, forms, hooke, problem, strain
from scipy.linalg import block_diag, null_space
from scipy.sparse import csr_array, diags_array

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.compat import assemble_csr
from tfeti_dolfinx.errors import ConformanceError, FactorError, InputError
from tfeti_dolfinx.subdomains import factor
from tfeti_dolfinx.subdomains import stiffness as traced
from tfeti_dolfinx.subdomains.block import (
    Counters,
    SubdomainData,
    candidate_modes,
    fixing_nodes,
    kernel_of,
)
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.kplus import KPLUS_TYPES, InverseFactory
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.testing import check_block, check_kind_of_block

RIGID = {"triangle": 3, "quadrilateral": 3, "tetrahedron": 6, "hexahedron": 6}


def stiffness(cell, n=2, degree=1, mass=0.0, scalar=False):
    """K and points of a box on one rank."""
    d = decomposed(cell, n, 1, comm=MPI.COMM_SELF)
    gdim = d.mesh.geometry.dim
    V = fem.functionspace(d.mesh, ("Lagrange", degree, () if scalar else (gdim,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    if scalar:
        a = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx
    else:
        a = ufl.inner(hooke()(u), strain(v)) * ufl.dx
    if mass:
        a += mass * ufl.inner(u, v) * ufl.dx
    return csr_array(assemble_csr(fem.form(a))), V.tabulate_dof_coordinates()[:, :gdim]


def data(K, x, every=3, **changes):
    arguments = dict(
        name="subdomain 5",
        K=K,
        f=np.random.default_rng(1).standard_normal(K.shape[0]),
        x=x,
        trace_dofs=np.arange(0, K.shape[0], every),
        body_frame=(x.mean(axis=0), 1.0),
        node_shares=np.ones(len(x)),
    )
    return SubdomainData(**{**arguments, **changes})


def block(K, x, every=3, counters=None, **changes):
    return SparseBlock(data(K, x, every, **changes), InverseFactory(counters or Counters()))


@pytest.mark.parametrize("cell", list(RIGID))
@pytest.mark.parametrize("degree", [1, 2])
def test_blocks_fulfil_their_contract(cell, degree):
    K, x = stiffness(cell, 2, degree)
    b = block(K, x)
    check_block(b, K)
    assert b.kernel.shape[1] == RIGID[cell]
    b.destroy()


def test_any_class_of_blocks_can_be_checked():
    check_kind_of_block(SparseBlock)


def test_blocks_of_a_scalar_problem_have_the_constants():
    K, x = stiffness("hexahedron", 3, scalar=True)
    b = block(K, x)
    check_block(b, K)
    assert b.kernel.shape[1] == 1


def test_a_mass_term_leaves_no_kernel():
    K, x = stiffness("hexahedron", 2, mass=1e-6)
    b = block(K, x)
    check_block(b, K)
    assert b.kernel.shape[1] == 0


def test_a_spring_leaves_a_smaller_kernel():
    K, x = stiffness("hexahedron", 2)
    spring = np.zeros(K.shape[0])
    spring[2::3] = 1e-3  # resists z: the translation and two rotations
    K = csr_array(K + diags_array(spring))
    b = block(K, x)
    check_block(b, K)
    assert b.kernel.shape[1] == 3


def test_kernel_where_the_stiffness_varies_by_nine_orders():
    K, x = stiffness("tetrahedron", 2)
    n = K.shape[0]
    K = csr_array(1e9 * K)
    modes = candidate_modes(x, 3, x.mean(axis=0), 1.0)
    assert kernel_of(K, modes).shape == (n, 6)


@pytest.mark.parametrize("thickness", [1.0, 0.1, 0.01, 1e-3])
def test_kernel_of_flat_triangles(thickness):
    """The ends have no entry across but that of a shear, a difference of far larger numbers."""
    h = 0.093541 * thickness
    for k in range(6):
        low = np.array([0.381886 + 0.7407867 * k, 1.784418 - 0.0935 * k])
        x = low + [[0, 0], [0.7407867, 0], [0.7407867, h], [2 * 0.7407867, h]]
        element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
        cells = np.array([[0, 1, 2], [1, 2, 3]])
        mesh = dmesh.create_mesh(MPI.COMM_SELF, cells=cells, x=x, e=element)
        V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        K = csr_array(assemble_csr(fem.form(ufl.inner(hooke()(u), strain(v)) * ufl.dx)))
        modes = candidate_modes(V.tabulate_dof_coordinates()[:, :2], 2, low, 1.0)
        assert kernel_of(K, modes).shape == (8, 3)


def test_generalised_inverse_of_the_whole_matrix():
    K, x = stiffness("hexahedron", 2)
    b = block(K, x, every=1)
    pinv = np.stack([b.apply_pinv(e) for e in np.eye(K.shape[0])], axis=1)
    dense = K.toarray()
    assert np.allclose(dense @ pinv @ dense, dense, atol=1e-12)
    assert np.allclose(pinv, pinv.T, atol=1e-12 * np.abs(pinv).max())


def test_a_new_load_leaves_the_factor_alone():
    K, x = stiffness("hexahedron", 2)
    counters = Counters()
    b = block(K, x, counters=counters)
    load = 2 * b.load
    b.update(f=load)
    assert np.array_equal(b.load, load)
    assert counters.factorizations == 1
    check_block(b, K)


def test_new_values_in_the_same_pattern_are_factored_without_an_analysis():
    """Also where the kernel shrinks or comes back: the pattern holds what the fixing nodes add."""
    K, x = stiffness("hexahedron", 2)
    springs = K.copy()
    springs.setdiag(K.diagonal() + 1e-3)
    counters = Counters()
    b = block(K.copy(), x, counters=counters)
    for matrix, kernel in [(2 * K, 6), (springs, 0), (K, 6)]:
        before = counters.factorizations, counters.analyses
        b.update(K=matrix.copy())
        assert (counters.factorizations, counters.analyses) == (before[0] + 1, before[1])
        assert b.kernel.shape[1] == kernel
        check_block(b, matrix)


def test_another_pattern_is_analysed_again():
    K, x = stiffness("hexahedron", 2)
    counters = Counters()
    b = block(K.copy(), x, counters=counters)
    spring = np.zeros(K.shape[0])
    spring[[0, -1]] = 1.0
    coupled = csr_array(K + diags_array(np.ones(K.shape[0])) + 1e-3 * np.outer(spring, spring))
    b.update(K=coupled)
    check_block(b, coupled)
    assert counters.factorizations == counters.analyses == 3  # and that of K_ii


def test_a_new_trace_leaves_the_factor_alone():
    K, x = stiffness("hexahedron", 2)
    counters = Counters()
    b = block(K, x, counters=counters)
    b.apply_schur(np.ones(len(b.trace_dofs)))
    b.apply_pinv(np.ones(len(b.trace_dofs)))
    b.retrace(np.arange(0, K.shape[0], 2))
    check_block(b, K)
    assert counters.factorizations == 3


def test_K_ii_is_factored_only_when_somebody_asks():
    K, x = stiffness("hexahedron", 2)
    counters = Counters()
    b = block(K, x, counters=counters)
    b.apply_stiffness(b.apply_pinv(np.ones(len(b.trace_dofs))))
    assert counters.factorizations == 1
    b.apply_schur(np.ones(len(b.trace_dofs)))
    assert counters.factorizations == 2


@pytest.mark.parametrize(("cell", "every"), [("triangle", 1), ("hexahedron", 3)])
def test_S_is_that_of_the_directions_that_rows_act_along(cell, every):
    K, x = stiffness(cell, 2)
    b, bs, n = block(K, x, every), x.shape[1], K.shape[0]
    trace, rng = np.flatnonzero(np.arange(n) // bs % every == 0), np.random.default_rng(0)
    b.retrace(trace)
    Q = np.linalg.qr(rng.standard_normal((len(trace) // bs, bs, bs)))[0]
    Q[::2, :, 1:] = 0.0  # one direction of every other node
    b.act_along((Q @ Q.transpose(0, 2, 1)).reshape(-1, bs))
    along = np.zeros((n, len(trace)))
    along[trace] = block_diag(*Q)
    along = along[:, np.any(along, axis=0)]
    left = null_space(along.T)  # the inside and the directions that are left
    A, C = left.T @ K @ left, left.T @ K @ along
    S = along.T @ K @ along - C.T @ np.linalg.lstsq(A, C, rcond=1e-10)[0]
    found = np.column_stack([b.apply_schur(w) for w in along[trace].T])
    assert np.allclose(along[trace].T @ found, S, atol=1e-10 * np.abs(K).max())
    b.act_along(np.tile(np.eye(bs), (len(trace) // bs, 1)))
    check_block(b, K)


def test_fixing_nodes_are_spread():
    _, x = stiffness("hexahedron", 4)
    nodes = fixing_nodes(x, 8)
    assert len(nodes) == 8
    distances = np.linalg.norm(x[nodes][:, None] - x[nodes], axis=2)
    assert distances[~np.eye(8, dtype=bool)].min() >= 0.5
    assert len(fixing_nodes(x[:3], 8)) == 3


def test_a_trace_that_does_not_hold_the_inside_has_a_schur_complement_too():
    K, x = stiffness("hexahedron", 2)
    normal_only = np.arange(2, K.shape[0], 3)[:4]
    check_block(block(K, x, trace_dofs=normal_only), K)


def test_a_form_that_is_not_symmetric_is_named():
    K, x = stiffness("hexahedron", 2)
    K = K.tolil()
    K[0, 1] += 1.0
    with pytest.raises(InputError, match="subdomain 5: the stiffness is not symmetric"):
        block(csr_array(K), x)


def test_stiffness_and_load_that_are_not_finite_are_named():
    K, x = stiffness("hexahedron", 2)
    with pytest.raises(InputError, match="subdomain 5: the load has 1 entries not finite"):
        block(K, x, f=np.append(np.zeros(K.shape[0] - 1), np.nan))
    with pytest.raises(InputError, match="subdomain 5: the stiffness has entries that are not"):
        block(csr_array((np.full_like(K.data, np.inf), K.indices, K.indptr), shape=K.shape), x)


def test_a_negative_stiffness_is_named():
    K, x = stiffness("hexahedron", 2)
    with pytest.raises(InputError, match="subdomain 5: .* diagonal entry -"):
        block(csr_array(-K), x)


@pytest.mark.parametrize(
    ("share", "message"),
    [
        (1e-3, "the stiffness is not positive semidefinite; expected a linear"),
        (1e-14, "the form gives no energy to 1 motion beside the 6 of a rigid body"),
        (0.0, "the form gives no energy to 1 motion beside the 6 of a rigid body"),
    ],
)
def test_a_negative_energy_is_told_from_none(share, message):
    """The softest deformation has a negative energy, as a share of the stiffest one's."""
    K, x = stiffness("hexahedron", 2)
    values, vectors = np.linalg.eigh(K.toarray())
    softest = vectors[:, RIGID["hexahedron"]]
    change = (values[RIGID["hexahedron"]] + share * values[-1]) * np.outer(softest, softest)
    with pytest.raises(InputError, match=f"subdomain 5: {message}"):
        block(csr_array(K - change), x)


@pytest.mark.parametrize("cell", ["quadrilateral", "triangle", "hexahedron", "tetrahedron"])
@pytest.mark.parametrize("flat", [1e3, 1e6, 1e9])
def test_flat_cells_are_not_taken_for_a_form_without_energy(cell, flat):
    """Their softest deformations are as free as those of a wrong form, and lost by rounding."""
    d = decomposed(cell, 2, 1, comm=MPI.COMM_SELF)
    d.mesh.geometry.x[:, 0] *= flat
    gdim = d.mesh.geometry.dim
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (gdim,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    form = ufl.inner(hooke()(u), strain(v)) * ufl.dx(metadata={"quadrature_degree": 2})
    K = csr_array(assemble_csr(fem.form(form)))
    said = ""
    try:
        block(K, V.tabulate_dof_coordinates()[:, :gdim])
    except InputError as error:
        said = str(error)
    assert not said or (flat > 1e3 and "indefinite by rounding" in said)


ENERGIES = {
    "div-div": lambda u, v: ufl.div(u) * ufl.div(v) * ufl.dx,
    "one point": lambda u, v: (
        ufl.inner(hooke()(u), strain(v)) * ufl.dx(metadata={"quadrature_degree": 0})
    ),
    "deviator": lambda u, v: ufl.inner(ufl.dev(strain(u)), strain(v)) * ufl.dx,
    "rotation": lambda u, v: ufl.inner(ufl.skew(ufl.grad(u)), ufl.grad(v)) * ufl.dx,
}
WITHOUT = [("quadrilateral", "div-div"), ("triangle", "div-div"), ("quadrilateral", "one point")]
WITHOUT += [("hexahedron", "deviator"), ("tetrahedron", "deviator"), ("triangle", "rotation")]


@pytest.mark.parametrize("kplus", list(KPLUS_TYPES))
@pytest.mark.parametrize(("cell", "energy"), WITHOUT)
def test_motions_without_energy_are_counted(cell, energy, kplus):
    """As many as dense eigenvalues say; rounding alone decided whether a factor was made."""
    d = decomposed(cell, 2, 1, comm=MPI.COMM_SELF)
    gdim = d.mesh.geometry.dim
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (gdim,)))
    form = ENERGIES[energy](ufl.TrialFunction(V), ufl.TestFunction(V))
    K, x = csr_array(assemble_csr(fem.form(form))), V.tabulate_dof_coordinates()[:, :gdim]
    values = np.linalg.eigvalsh(K.toarray())
    rigid = kernel_of(K, candidate_modes(x, gdim, x.mean(axis=0), 1.0)).shape[1]
    free = int(np.sum(values < 1e-10 * values[-1])) - rigid
    assert free > 0
    count = f"{free} motion{'s' * (free > 1)}"
    with pytest.raises(
        InputError, match=f"the form gives no energy to {count} beside the {rigid} of a rigid body"
    ):
        SparseBlock(data(K, x), InverseFactory(kplus=KPLUS_TYPES[kplus]))


@pytest.fixture(params=factor.SOLVERS)
def solver(request, monkeypatch):
    """PETSc as if it had this solver and those that come after it, but not those before."""
    missing = factor.SOLVERS[: factor.SOLVERS.index(request.param)]
    has_solver = factor.has_solver
    monkeypatch.setattr(factor, "has_solver", lambda s: s not in missing and has_solver(s))
    for cached in (factor.default_solver, factor._say):
        cached.cache_clear()
    if not factor.has_solver(request.param):
        pytest.skip(f"this PETSc has no {request.param}")
    yield request.param
    for cached in (factor.default_solver, factor._say):
        cached.cache_clear()


NO_FACTOR = {
    "singular": [[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "indefinite": [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "negative": [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
}


@pytest.mark.parametrize("kind", list(NO_FACTOR))
def test_cholesky_says_when_there_is_no_factor(solver, kind, capfd):
    """Also where the solver would make one: LDLᵀ takes pivots of any sign. It alone says it."""
    with pytest.raises(NotPositiveDefiniteError, match=f"not positive definite.*{solver}"):
        CholeskyFactor(csr_array(np.array(NO_FACTOR[kind])))
    assert capfd.readouterr() == ("", "")


def test_every_solver_factors(solver):
    K, _ = stiffness("tetrahedron", 2, mass=1.0)
    found = CholeskyFactor(K)
    b = np.random.default_rng(0).standard_normal(K.shape[0])
    assert np.allclose(K @ found.solve(b), b, atol=1e-9)
    found.destroy()


def test_what_stands_in_for_cholmod_is_said_once(solver, caplog):
    d = decomposed("quadrilateral", 3, 2)
    for _ in range(2):
        problem(d, (0.0, -0.05)).solve()
    said = [r.getMessage() for r in caplog.records if "built without CHOLMOD" in r.getMessage()]
    assert len(said) == (solver != "cholmod" and d.comm.rank == 0)


def test_a_solver_that_is_missing_is_named(comm):
    name = "tfeti_sub_pc_factor_mat_solver_type"
    p = problem(decomposed("quadrilateral", 3, 2), (0.0, -0.05), **{name: "nosuch"})
    with pytest.raises(FactorError, match=r"subdomain 0: .* factors by nosuch; expected one of"):
        p.solve()
    assert not PETSc.Options().hasName(name)


@pytest.mark.parametrize("family", ["sub", "coarse"])
def test_a_value_that_petsc_cannot_read(family):
    says = rf"PETSc, with options -tfeti_{family}_\.\.\., failed: .* abc has no numeric value"
    with pytest.raises(FactorError, match=says):
        problem(decomposed("triangle"), **{f"tfeti_{family}_pc_factor_fill": "abc"}).solve()


def test_factors_heed_options_with_their_prefix(monkeypatch):
    made = []
    cholesky = factor._factored

    def factored(pc, matrix, prefix):
        found = cholesky(pc, matrix, prefix)
        made.append((prefix, pc.getFactorSolverType()))
        return found

    monkeypatch.setattr(factor, "_factored", factored)
    options = {"my_sub_pc_factor_mat_solver_type": "petsc"}
    d = decomposed("quadrilateral", 3, 1, comm=MPI.COMM_SELF)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, -0.05), d.surface("top"))
    bcs = [clamp(V, d.facets("left"))]
    arguments = dict(petsc_options=options, petsc_options_prefix="my_")
    tfeti.ContactProblem(a, L, bcs, [], d, **arguments).solve()
    assert set(made) == {("my_sub_", "petsc"), ("my_coarse_", factor.default_solver())}


def test_a_factor_without_memory_is_named():
    class NoMemory(PETSc.Error):
        ierr = factor.OUT_OF_MEMORY

    A = csr_array(np.eye(3))
    cause = factor._cause(NoMemory(factor.OUT_OF_MEMORY), "cholmod", factor.as_petsc_matrix(A))
    assert "out of memory: cholmod had none for the factor of 3 unknowns with 3" in str(cause)


def test_a_factor_that_only_the_preconditioner_needs_fails_on_all_ranks(monkeypatch):
    """K_ii is made where all ranks can raise together, not within a multiplication."""
    d = decomposed("quadrilateral", 4, 4)
    unlucky = d.comm.allreduce(int(d.subdomains.min(initial=99)), op=MPI.MAX)
    regularised = traced.regularised

    def fails(K, R, fixing_dofs, prefix):
        if unlucky in d.subdomains:
            raise FactorError("out of memory")
        return regularised(K, R, fixing_dofs, prefix)

    monkeypatch.setattr(traced, "regularised", fails)
    p = problem(d, (0.0, -0.05), tfeti_pc_type="dirichlet")
    with pytest.raises(FactorError, match=r"subdomain \d: .*dirichlet preconditioner: out of mem"):
        p.solve()


def test_an_implementation_that_breaks_its_promises_is_named():
    K, x = stiffness("quadrilateral", 2)
    b = block(K, x)
    with pytest.raises(ConformanceError, match="this does not hold: apply_stiffness is K_bb"):
        b.apply_stiffness = lambda w: 2 * w
        check_block(b, K)
    del b.apply_stiffness
    with pytest.raises(ConformanceError, match=r"this does not hold: a Block has load, kernel, d"):
        check_block(SimpleNamespace(trace_dofs=b.trace_dofs), K)
    with pytest.raises(ConformanceError, match="this does not hold: K⁺ is symmetric"):
        b.apply_pinv = lambda w: np.roll(w, 1)
        check_block(b, K)
