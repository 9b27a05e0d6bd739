"""Local operators: all forms apply the same, equal subdomains are factored once."""

import numpy as np
import pytest
from mpi4py import MPI
from scenes import box, curved_obstacle, decomposed, problem
from scipy.sparse import csr_array, diags_array, eye_array
from test_blocks import data, stiffness
from test_dual import check_operator

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.arrays import parts_of
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.subdomains.factor import added_options, inverse_on
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.local_operators import GroupedOperator, LocalChoice
from tfeti_dolfinx.subdomains.sparse_block import EqualSubdomains, SparseBlock
from tfeti_dolfinx.testing import check_block, check_kind_of_block

KINDS = ("pinv", "stiffness", "schur")


def cubes(cell, parts=2, cells=2):
    """A box whose subdomains are equal boxes, in rows of so many."""
    mesh, facet_tags, names = box(cell, parts * cells)
    gdim = mesh.geometry.dim

    def subdomain(x):
        index = np.minimum((x[:gdim] * parts).astype(int), parts - 1)
        return parts ** np.arange(gdim) @ index

    return tfeti.decompose(mesh, subdomain, facet_tags=facet_tags, surfaces=names)


def made(d, local_type="auto", contact=True, **options):
    """A problem and its subdomains, the dual made but not solved."""
    gdim = d.mesh.geometry.dim
    contacts = [tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=np.inf)] if contact else []
    p = problem(d, contacts=contacts, tfeti_local_type=local_type, **options)
    p._system.look_for_changes()
    return p, p._system.make({}).subdomains


def random(n):
    return np.random.default_rng(MPI.COMM_WORLD.rank).standard_normal(n)


def applied(operator, w):
    out = np.full_like(w, np.nan)
    operator.prepare()
    operator.mult(w, out)
    operator.destroy()
    return out


def blockwise(blocks, kind, w):
    """Each Block applies its own, one after the other."""
    out, parts = np.full_like(w, np.nan), parts_of([len(block.trace_dofs) for block in blocks])
    for block, part in zip(blocks, parts, strict=True):
        block.prepare(kind)
        out[part] = getattr(block, f"apply_{kind}")(w[part])
    return out


def close(x, y, comm):
    """Whether arrays agree to 1e-10 of the largest entry of all ranks."""
    largest = comm.allreduce(np.abs(y).max(initial=0.0), op=MPI.MAX)
    return comm.allreduce(bool(np.abs(x - y).max(initial=0.0) <= 1e-10 * largest), op=MPI.LAND)


@pytest.mark.parametrize(
    ("cell", "equal"), [("triangle", False), ("quadrilateral", True), ("hexahedron", False)]
)
def test_all_forms_apply_the_same(cell, equal):
    """Also on subdomains with contact rows, with prescribed values, and of several shapes.

    K⁺ is compared on forces that are in balance: generalised inverses of a place of its own each
    differ by rigid motions.
    """
    d = cubes(cell) if equal else decomposed(cell, 4, 5)
    p, subdomains = made(d)
    alone, single = made(d, "implicit")
    w = random(len(subdomains.trace))
    for kind in KINDS:
        for s in (subdomains, single):
            expected = blockwise(s.blocks, kind, w)
            for form in ("implicit", "explicit"):
                operator = GroupedOperator(s.blocks, kind, LocalChoice(form))
                assert close(applied(operator, w), expected, d.comm)
    R = subdomains.kernel_rows.toarray()
    balanced = w - R @ np.linalg.lstsq(R, w, rcond=None)[0]
    u, v = (applied(s.local_operator("pinv"), balanced) for s in (subdomains, single))
    assert close(balanced @ u, balanced @ v, d.comm)
    check_operator(p.dual.F, d.comm, len(p.dual.d))
    for item in (p, alone):
        item.destroy()


@pytest.mark.parametrize(("cell", "equal"), [("triangle", False), ("quadrilateral", True)])
def test_one_factor_gives_both(cell, equal):
    """K⁺ by a factor with the trace last, S of it; K_ii is not factored for either."""
    d = cubes(cell, cells=6) if equal else decomposed(cell, 4, 24)
    p, subdomains = made(d, "explicit")
    w, counters = random(len(subdomains.trace)), subdomains.counters
    expected = [blockwise(subdomains.blocks, kind, w) for kind in ("pinv", "schur")]
    F = GroupedOperator(subdomains.blocks, "pinv", LocalChoice("explicit"))
    F.prepare()
    before = counters.factorizations
    for block in subdomains.blocks:
        block.traced.__dict__.pop("inner", None)
    S = GroupedOperator(subdomains.blocks, "schur", LocalChoice("explicit"))
    S.prepare()
    for operator, product in zip((F, S), expected, strict=True):
        operator.mult(w, out := np.full_like(w, np.nan))
        assert close(out, product, d.comm)
    assert counters.factorizations == before
    assert not any("inner" in block.traced.__dict__ for block in subdomains.blocks)
    # a trace that leaves a turn free, and one that K⁺ is not known on, take the factor of K_ii
    for block in subdomains.blocks:
        some, all_of_it = block.trace_dofs[:1], np.arange(len(block.place))
        inside = len(block.stiffness.dense().trace) < len(all_of_it)
        block.retrace(some)
        assert block.traced.schur() is None
        block.retrace(all_of_it)
        assert (block.traced.schur() is None) == inside
    p.destroy()


def test_a_solver_that_is_asked_for_makes_all_factors():
    d = decomposed("triangle", 4, 8)
    p, subdomains = made(d, "explicit")
    w, counters = random(len(subdomains.trace)), subdomains.counters
    for block in subdomains.blocks:
        block.traced.__dict__.pop("pinv", None)
    before = counters.factorizations
    with added_options("tfeti_sub_", {"pc_factor_mat_solver_type": "petsc"}):
        F = applied(subdomains.local_operator("pinv"), w)
    assert close(F, blockwise(subdomains.blocks, "pinv", w), d.comm)
    assert counters.factorizations == before
    p.destroy()


@pytest.mark.parametrize("inside", [1, 2, 5, 8, 50, 499])
def test_a_trace_of_nearly_all_unknowns_or_few(inside):
    """MUMPS counts too little space where few are inside."""
    n = 500
    neighbours = diags_array([np.full(n - k, -1.0) for k in (1, 5, 25)], offsets=[1, 5, 25])
    A = csr_array(neighbours + neighbours.T + 6.5 * eye_array(n))
    last = np.delete(np.arange(n), np.random.default_rng(0).choice(n, inside, replace=False))
    expected = np.linalg.inv(A.toarray())[np.ix_(last, last)]
    assert np.allclose(np.triu(inverse_on(A, last)), np.triu(expected), atol=1e-12)


def test_a_matrix_of_the_trace_that_is_indefinite_is_named():
    K = csr_array(np.diag([1.0, 2.0, -1.0]))
    with pytest.raises(FactorError, match="not positive definite"):
        inverse_on(K, np.array([1, 2], dtype=np.int32))
    with pytest.raises(FactorError, match="not positive definite"):
        inverse_on(K, np.arange(3))


def test_equal_subdomains_are_factored_once():
    d = cubes("tetrahedron")
    p, subdomains = made(d, "shared", tfeti_pc_type="lumped")
    counters = subdomains.counters
    ranks_with_any = d.comm.allreduce(int(len(d.subdomains) > 0))
    assert d.comm.allreduce(counters.factorizations) == ranks_with_any
    assert len({id(block.stiffness) for block in subdomains.blocks}) <= 1
    forms = subdomains.local_operator("pinv")
    forms.prepare()
    assert sum(forms.forms.values()) == len(subdomains.blocks)
    p.destroy()
    p, subdomains = made(d, "implicit", tfeti_pc_type="lumped")
    assert subdomains.counters.factorizations == len(subdomains.blocks)
    assert len({id(block.stiffness) for block in subdomains.blocks}) == len(subdomains.blocks)
    p.destroy()


@pytest.mark.parametrize(
    ("local_type", "contact"), [("shared", True), ("explicit", False), ("auto", True)]
)
def test_the_answer_does_not_depend_on_the_form(local_type, contact):
    u, reports = [], []
    for name in ("implicit", local_type):
        d = cubes("hexahedron")
        contacts = [tfeti.Obstacle("bottom", curved_obstacle(3))] if contact else []
        p = problem(d, contacts=contacts, tfeti_local_type=name, tfeti_rtol=1e-9)
        u.append(p.solve().x.array.copy())
        reports.append(p.report)
        p.destroy()
    largest = d.comm.allreduce(np.abs(u[0]).max(initial=0.0), op=MPI.MAX)
    assert np.abs(u[1] - u[0]).max(initial=0.0) <= 1e-8 * largest
    first, second = (r.F_multiplications for r in reports)
    assert abs(first - second) <= 2
    assert reports[0].local_operators["F_implicit"] == reports[0].subdomains == 8
    found = reports[1].local_operators
    assert sum(v for k, v in found.items() if k.startswith("F_") and k[2:] in FORMS) == 8


FORMS = ("implicit", "explicit", "shared_implicit", "shared_explicit")


def shared(K, x, equals, shift=0.0, order=None, **changes):
    """A Block of a stiffness somewhere else, its nodes in another order."""
    bs = K.shape[0] // len(x)
    order = np.arange(len(x)) if order is None else order
    dofs = (order[:, None] * bs + np.arange(bs)).ravel()
    K = csr_array(K.tocsr()[dofs][:, dofs])
    K.sort_indices()
    given = data(K, x[order] + shift, **changes)
    return SparseBlock(given, equals=equals), K


@pytest.fixture
def equals():
    return EqualSubdomains(InverseFactory())


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_friends_in_another_place_and_order(cell, equals):
    K, x = stiffness(cell, 3)
    first, _ = shared(K, x, equals)
    order = np.random.default_rng(0).permutation(len(x))
    second, moved = shared(K, x, equals, shift=7.3, order=order)
    assert second.stiffness is first.stiffness
    check_block(second, moved)
    first.destroy()
    check_block(second, moved)  # who stays keeps the factor
    second.destroy()


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_false_friends_are_told_apart(cell, equals):
    """Of the same shape: another modulus, also a hair's breadth, one soft cell, another size."""
    K, x = stiffness(cell, 3)
    first, _ = shared(K, x, equals)
    for other, points in ((2 * K, x), ((1 + 1e-9) * K, x), (K, 2 * x)):
        block, _ = shared(other, points, equals)
        same = points is not x and np.array_equal(other.data, K.data)
        # a shape of another size has rotations of another length, but the same kernel
        assert (block.stiffness is first.stiffness) == same
        check_block(block, other)
    dense = K.toarray()
    dense[0, 0] += 1e-6
    block, changed = shared(csr_array(dense), x, equals)
    assert block.stiffness is not first.stiffness
    check_block(block, changed)


def test_shared_blocks_keep_the_promises_of_a_block(equals):
    check_kind_of_block(lambda data: SparseBlock(data, equals=equals))
