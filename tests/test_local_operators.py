"""Local operators: all forms apply the same, equal subdomains are factored once."""

import numpy as np
import pytest
from mpi4py import MPI
from scenes import apart, curved_obstacle, decomposed, grid, problem
from scipy.sparse import csr_array
from test_blocks import data, stiffness
from test_dual import check_operator
from test_solvability import dual_of

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.arrays import LocalMatrix, parts_of
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.local_operators import GroupedOperator, LocalChoice
from tfeti_dolfinx.subdomains.sparse_block import EqualSubdomains, SparseBlock
from tfeti_dolfinx.testing import check_block, check_kind_of_block

KINDS = ("pinv", "stiffness", "schur")


def made(d, local_type="auto", contact=True, **options):
    """A problem and its subdomains, the dual made but not solved."""
    gdim = d.mesh.geometry.dim
    contacts = [tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=np.inf)] if contact else []
    p = problem(d, contacts=contacts, tfeti_local_type=local_type, **options)
    return p, dual_of(p).subdomains


def random(n):
    return np.random.default_rng(MPI.COMM_WORLD.rank).standard_normal(n)


def applied(operator, w):
    out = np.full_like(w, np.nan)
    operator.prepare()
    operator.mult(w, out)
    return out


def blockwise(blocks, kind, w):
    """Each Block applies its own, one after the other."""
    out, parts = np.full_like(w, np.nan), parts_of([len(block.trace_dofs) for block in blocks])
    for block, part in zip(blocks, parts, strict=True):
        block.prepare(kind)
        out[part] = getattr(block, f"apply_{kind}")(w[part])
    return out


@pytest.mark.parametrize(
    ("cell", "equal"), [("triangle", False), ("quadrilateral", True), ("hexahedron", False)]
)
def test_all_forms_apply_the_same(cell, equal):
    """Also on subdomains with contact rows, with prescribed values, and of several shapes.

    K⁺ is compared on forces that are in balance: generalised inverses of a place of its own each
    differ by rigid motions. S from a dense K⁺ is that through K_ii, which is made before.
    """
    d = decomposed(cell, 4, grid(2) if equal else 5)
    p, subdomains = made(d)
    alone, single = made(d, "implicit")
    w = random(len(subdomains.trace))
    through_inside = single.local_operator("schur")
    through_inside.prepare()
    for kind in KINDS:
        for s in (subdomains, single):
            expected = blockwise(s.blocks, kind, w)
            for form in ("implicit", "explicit"):
                operator = GroupedOperator(s.blocks, kind, LocalChoice(form))
                assert apart(applied(operator, w), expected) <= 1e-10
    explicit, dense = made(d, "explicit")
    traced = [block.traced for block in dense.blocks]
    known = all(t.schur is not None for t in traced if len(t.inside) and len(t.trace))
    assert d.comm.allreduce(known, op=MPI.LAND)
    assert apart(applied(dense.local_operator("schur"), w), applied(through_inside, w)) <= 1e-10
    R = subdomains.kernel_rows.toarray()
    balanced = w - R @ np.linalg.lstsq(R, w, rcond=None)[0]
    u, v = (applied(s.local_operator("pinv"), balanced) for s in (subdomains, single))
    assert apart(balanced @ u, balanced @ v) <= 1e-10
    check_operator(p.dual.F, d.comm, len(p.dual.d))


def test_equal_subdomains_are_factored_once():
    d = decomposed("tetrahedron", 4, grid(2))
    p, subdomains = made(d, "shared", tfeti_pc_type="lumped")
    ranks_with_any = d.comm.allreduce(int(len(d.subdomains) > 0))
    assert d.comm.allreduce(p._system.factory.factorizations) == ranks_with_any
    assert len({id(block.stiffness) for block in subdomains.blocks}) <= 1
    forms = subdomains.local_operator("pinv")
    forms.prepare()
    assert sum(forms.forms.values()) == len(subdomains.blocks)
    p.destroy()
    p, subdomains = made(d, "implicit", tfeti_pc_type="lumped")
    assert p._system.factory.factorizations == len(subdomains.blocks)
    assert len({id(block.stiffness) for block in subdomains.blocks}) == len(subdomains.blocks)


@pytest.mark.parametrize(
    ("local_type", "contact"), [("shared", True), ("explicit", False), ("auto", True)]
)
def test_the_answer_does_not_depend_on_the_form(local_type, contact):
    u, reports = [], []
    for name in ("implicit", local_type):
        d = decomposed("hexahedron", 4, grid(2))
        contacts = [tfeti.Obstacle("bottom", curved_obstacle(3))] if contact else []
        p = problem(d, contacts=contacts, tfeti_local_type=name, tfeti_rtol=1e-9)
        u.append(p.solve().x.array.copy())
        reports.append(p.report)
        p.destroy()
    assert apart(u[1], u[0]) <= 1e-8
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


@pytest.mark.parametrize("columns", [0, 1, 3])
def test_products_with_any_number_of_columns(columns):
    """Newer PETSc refuses products with none."""
    A = csr_array(np.arange(6.0).reshape(2, 3))
    x, y = np.ones((3, columns)), np.ones((2, columns))
    assert np.array_equal(LocalMatrix(A) @ x, A @ x)
    assert np.array_equal(LocalMatrix(A).transposed(y), A.T @ y)
