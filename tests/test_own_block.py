"""A kind of subdomain of one's own: dense, in a few lines."""

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, problem
from scipy.linalg import pinvh
from test_solvable_lp import dual_of

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.solver import solve_dual
from tfeti_dolfinx.subdomains.block import BlockDefaults
from tfeti_dolfinx.subdomains.build import make_subdomains, subdomain_data
from tfeti_dolfinx.subdomains.conformance import check_kind_of_block
from tfeti_dolfinx.subdomains.kernel import kernel_of


class DenseBlock(BlockDefaults):
    """K and its Moore–Penrose inverse, dense."""

    def set_stiffness(self, K):
        self.kernel, self.diagonal = kernel_of(K, self.modes), K.diagonal()
        self.K = K.toarray()
        self.pinv = pinvh(self.K, rtol=1e-12)

    def multiply(self, u):
        return self.K @ u

    def solve(self, b):
        return self.pinv @ b

    def apply_schur(self, w):
        inner = np.setdiff1d(np.arange(len(self.K)), self.trace_dofs)
        u = self._extended(w)
        u[inner] = -pinvh(self.K[np.ix_(inner, inner)]) @ (self.K @ u)[inner]
        return (self.K @ u)[self.trace_dofs]


def test_it_keeps_the_promises_of_a_block():
    check_kind_of_block(DenseBlock)


@pytest.mark.parametrize("pc_type", ["none", "lumped", "dirichlet"])
def test_it_solves_a_scene(pc_type):
    d = decomposed("hexahedron", 3, 4)
    contacts = [tfeti.Obstacle("bottom", curved_obstacle(3))] if pc_type == "none" else []
    p = problem(d, contacts=contacts, tfeti_rtol=1e-9)
    p.solve()
    expected, dual = p.u.x.array.copy(), dual_of(p)
    arguments = (
        p.dofs,
        d,
        p._system.forms.stiffness(),
        p._system.forms.load(),
        dual.constraints.trace,
    )
    own = make_subdomains(subdomain_data(*arguments), DenseBlock, d)
    dense = Dual(dual.constraints, own, d.body_names, "xyzabc", pc_type)
    result, accuracy = solve_dual(dense, p.options, "smalse" if contacts else "pcpg")
    assert result.reason > 0
    found = p.dofs.to_dolfinx(accuracy.u)
    largest = d.comm.allreduce(np.abs(expected).max(initial=0.0), op=max)
    assert np.abs(found - expected).max(initial=0.0) <= 1e-7 * largest
    p.destroy()


def test_what_it_refuses_is_raised_on_all_ranks():
    d = decomposed("quadrilateral", 4, 4)
    p = problem(d, (0.0, -0.05))
    dual = dual_of(p)
    unlucky = d.comm.allreduce(int(d.subdomains.min(initial=99)), op=max)

    def refuses(s):
        if s.name == f"subdomain {unlucky}":
            raise InputError(f"{s.name}: not for me")
        return DenseBlock(s)

    arguments = (
        p.dofs,
        d,
        p._system.forms.stiffness(),
        p._system.forms.load(),
        dual.constraints.trace,
    )
    with pytest.raises(InputError, match=f"subdomain {unlucky}: not for me"):
        make_subdomains(subdomain_data(*arguments), refuses, d)
