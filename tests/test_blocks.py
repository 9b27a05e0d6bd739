"""Blocks: generalised inverses, kernels, Schur complements."""

from types import SimpleNamespace

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc
from scenes import clamp, decomposed, forms, hooke, problem, strain
from scipy.sparse import csr_array, diags_array, eye_array, tril

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.arrays import as_petsc_matrix
from tfeti_dolfinx.common.compat import assemble_csr
from tfeti_dolfinx.errors import ConformanceError, FactorError, InputError
from tfeti_dolfinx.feti.preconditioner import ContactFactor
from tfeti_dolfinx.subdomains import factor
from tfeti_dolfinx.subdomains import sparse_block as traced
from tfeti_dolfinx.subdomains.block import SubdomainData, candidate_modes, kernel_of
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.testing import check_block

RIGID = {"triangle": 3, "quadrilateral": 3, "tetrahedron": 6, "hexahedron": 6}
ENERGIES = {
    "elastic": lambda u, v: ufl.inner(hooke()(u), strain(v)) * ufl.dx,
    "scalar": lambda u, v: ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx,
    "div-div": lambda u, v: ufl.div(u) * ufl.div(v) * ufl.dx,
    "one point": lambda u, v: ufl.inner(hooke()(u), strain(v)) * ufl.dx(degree=0),
    "deviator": lambda u, v: ufl.inner(ufl.dev(strain(u)), strain(v)) * ufl.dx,
}


def stiffness(cell, n=2, degree=1, mass=0.0, energy="elastic", length=1.0):
    """K and points of a box on one rank."""
    d = decomposed(cell, n, 1, comm=MPI.COMM_SELF)
    d.mesh.geometry.x[:, 0] *= length
    gdim = d.mesh.geometry.dim
    V = fem.functionspace(d.mesh, ("Lagrange", degree, () if energy == "scalar" else (gdim,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ENERGIES[energy](u, v)
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


def block(K, x, every=3, factory=None, **changes):
    return SparseBlock(data(K, x, every, **changes), factory)


@pytest.mark.parametrize(("what", "left"), [("scalar", 1), ("mass", 0), ("spring", 3)])
def test_the_kernel_is_what_the_form_leaves_free(what, left):
    """A spring along z leaves two translations and a turn."""
    energy = what if what in ENERGIES else "elastic"
    K, x = stiffness("hexahedron", mass=1e-6 * (what == "mass"), energy=energy)
    if what == "spring":
        K = csr_array(K + diags_array(np.tile([0.0, 0.0, 1e-3], len(x))))
    b = block(K, x)
    check_block(b, K)
    assert b.stiffness.null.shape[1] == left


def test_factors_are_made_when_they_are_needed_and_kept():
    """K's for any load and trace, K_ii's for a trace, when somebody asks for S."""
    K, x = stiffness("hexahedron", 2)
    factory = InverseFactory()
    b = block(K, x, factory=factory)
    b.apply_stiffness(b.apply_pinv(np.ones(len(b.trace_dofs))))
    load = 2 * b.load
    b.update(f=load)
    assert np.array_equal(b.load, load)
    assert factory.factorizations == 1
    b.apply_schur(np.ones(len(b.trace_dofs)))
    assert factory.factorizations == 2
    b.retrace(np.arange(0, K.shape[0], 2))
    check_block(b, K)
    assert factory.factorizations == 3


def infinite(K):
    return csr_array((np.full_like(K.data, np.inf), K.indices, K.indptr), shape=K.shape)


@pytest.mark.parametrize(
    ("change", "load", "message"),
    [
        (lambda K: csr_array(tril(K)), 0.0, "the stiffness is not symmetric"),
        (infinite, 0.0, "the stiffness has entries that are not"),
        (lambda K: csr_array(-K), 0.0, ".* diagonal entry -"),
        (lambda K: K, np.nan, "the load has 1 entries not finite"),
    ],
)
def test_what_is_wrong_with_stiffness_or_load_is_named(change, load, message):
    K, x = stiffness("hexahedron", 2)
    f = np.append(np.zeros(K.shape[0] - 1), load)
    with pytest.raises(InputError, match=f"subdomain 5: {message}"):
        block(change(K), x, f=f)


@pytest.mark.parametrize(
    ("share", "message"),
    [
        (
            1e-3,
            "the stiffness is not positive semidefinite; expected a linear elastic form, or of a n",
        ),
        (0.0, "the form gives no energy to motions besides the 6 of a rigid body"),
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


WITHOUT = [("triangle", "div-div"), ("quadrilateral", "one point"), ("hexahedron", "deviator")]


@pytest.mark.parametrize(("cell", "energy"), WITHOUT)
def test_motions_without_energy_are_named(cell, energy):
    """Rounding alone decides whether a factor is made."""
    K, x = stiffness(cell, energy=energy)
    rigid = kernel_of(K, candidate_modes(x, x.shape[1], x.mean(axis=0), 1.0)).shape[1]
    with pytest.raises(InputError, match=f"gives no energy to motions besides the {rigid} of"):
        block(K, x)


@pytest.fixture(params=factor.PACKAGES)
def solver(request, monkeypatch):
    """PETSc as if it had this solver and those that come after it, but not those before."""
    missing = factor.PACKAGES[: factor.PACKAGES.index(request.param)]
    has_solver = factor.has_solver
    monkeypatch.setattr(factor, "has_solver", lambda s: s not in missing and has_solver(s))
    for cached in (factor.default_solver, factor.say_if_not_cholmod):
        cached.cache_clear()
    if not factor.has_solver(request.param):
        pytest.skip(f"this PETSc has no {request.param}")
    yield request.param
    for cached in (factor.default_solver, factor.say_if_not_cholmod):
        cached.cache_clear()


NO_FACTOR = {
    "singular": [[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "indefinite": [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
}


@pytest.mark.parametrize("kind", list(NO_FACTOR))
def test_cholesky_says_when_there_is_no_factor(solver, kind, capfd):
    """Also where the solver would make one: LDLᵀ takes pivots of any sign. It alone says it."""
    with pytest.raises(NotPositiveDefiniteError, match=f"not positive definite.*{solver}"):
        CholeskyFactor(csr_array(np.array(NO_FACTOR[kind])))
    assert capfd.readouterr() == ("", "")


def test_every_solver_factors_and_what_stands_in_for_cholmod_is_said_once(solver, caplog):
    K, _ = stiffness("tetrahedron", 2, mass=1.0)
    found, b = CholeskyFactor(K), np.random.default_rng(0).standard_normal(K.shape[0])
    assert np.allclose(K @ found.solve(b), b, atol=1e-9)
    d = decomposed("quadrilateral", 3, 2)
    for _ in range(2):
        problem(d, (0.0, -0.05)).solve()
    said = [r.getMessage() for r in caplog.records if "built without CHOLMOD" in r.getMessage()]
    assert len(said) == (solver != "cholmod" and d.comm.rank == 0)


@pytest.mark.parametrize("whole", [0, 99])
def test_a_factor_of_contact_rows_is_shared_by_ranks_or_whole_on_each(comm, whole):
    K = diags_array([[-1.0] * 39, [2.5] * 40, [-1.0] * 39], offsets=[-1, 0, 1]).tocsr()
    x, own = np.arange(40.0), slice(*(40 * np.array([comm.rank, comm.rank + 1]) // comm.size))
    layout = 2 * ((own.stop - own.start, 40),)
    for change in (3.0, 0.0):  # the first one is indefinite
        part = csr_array(K - change * eye_array(40))[own]
        A = PETSc.Mat().createAIJ(layout, csr=(part.indptr, part.indices, part.data), comm=comm)
        if change:
            kept = A.createVecLeft()  # PETSc's communicator ends with its last object
            with pytest.raises(NotPositiveDefiniteError, match="not positive definite"):
                ContactFactor(A, "tfeti_face_", whole)
    found = ContactFactor(A, "tfeti_face_", whole)
    assert np.allclose(found.solve((K @ x)[own]), x[own], atol=1e-12)
    found.destroy()
    kept.destroy()


def test_a_solver_that_is_missing_is_named():
    """It is asked for with a prefix of one's own."""
    name, d = "my_sub_pc_factor_mat_solver_type", decomposed("quadrilateral", 3, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, -0.05), d.surface("top"))
    options = dict(petsc_options={name: "nosuch"}, petsc_options_prefix="my_")
    p = tfeti.ContactProblem(a, L, [clamp(V, d.facets("left"))], [], d, **options)
    with pytest.raises(FactorError, match=r"subdomain 0: .* factors by nosuch; expected one of"):
        p.solve()
    assert not PETSc.Options().hasName(name)


def test_values_that_petsc_cannot_read_and_factors_without_memory_are_named():
    with pytest.raises(FactorError, match=r"-tfeti_sub_\.\.\., .* abc has no numeric value"):
        problem(decomposed("triangle"), tfeti_sub_pc_factor_fill="abc").solve()

    class NoMemory(PETSc.Error):
        ierr = factor.PetscError.OUT_OF_MEMORY

    A = csr_array(np.eye(3))
    cause = factor._cause(NoMemory(factor.PetscError.OUT_OF_MEMORY), "cholmod", as_petsc_matrix(A))
    assert "out of memory: cholmod had none for the factor of 3 unknowns with 3" in str(cause)


def test_a_factor_that_only_the_preconditioner_needs_fails_on_all_ranks(monkeypatch):
    """K_ii is made where all ranks can raise together, not within a multiplication."""
    d = decomposed("quadrilateral", 4, 4)
    unlucky = d.comm.allreduce(int(d.subdomains.min(initial=99)), op=MPI.MAX)
    regularised = traced.regularised

    def fails(*given):
        if unlucky in d.subdomains:
            raise FactorError("out of memory")
        return regularised(*given)

    monkeypatch.setattr(traced, "regularised", fails)
    p = problem(d, (0.0, -0.05), tfeti_pc_type="dirichlet", tfeti_local_type="implicit")
    with pytest.raises(FactorError, match=r"subdomain \d: .*dirichlet preconditioner: out of mem"):
        p.solve()


def test_an_implementation_that_breaks_its_promises_is_named():
    K, x = stiffness("quadrilateral", 2)
    b = block(K, x)
    with pytest.raises(ConformanceError, match="this does not hold: apply_stiffness is K_bb"):
        b.apply_stiffness = lambda w: 2 * w
        check_block(b, K)
    del b.apply_stiffness
    with pytest.raises(ConformanceError, match="a Block has load, kernel, springs, diagonal"):
        check_block(SimpleNamespace(trace_dofs=b.trace_dofs), K)
    with pytest.raises(ConformanceError, match="this does not hold: K⁺ is symmetric"):
        b.apply_pinv = lambda w: np.roll(w, 1)
        check_block(b, K)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_flat_cells_are_not_taken_for_a_form_without_energy(cell):
    """Their softest deformations are as free as those of a wrong form, and lost by rounding."""
    with pytest.raises(InputError, match="indefinite by rounding"):
        block(*stiffness(cell, length=1e9))
