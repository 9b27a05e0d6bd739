"""A kind of subdomain of one's own, dense, in a few lines."""

import numpy as np
import pytest
from scenes import apart, curved_obstacle, decomposed, problem
from scipy.linalg import pinvh
from test_extensions import solved

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.subdomains.block import Block, kernel_of
from tfeti_dolfinx.testing import check_kind_of_block


class DenseBlock(Block):
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


@pytest.mark.parametrize("pc_type", ["auto", "lumped"])
def test_it_solves_a_scene(pc_type):
    contacts = [tfeti.Obstacle("bottom", curved_obstacle(3))] if pc_type == "auto" else []
    known, own = (
        solved(contacts, extensions, tfeti_pc_type=pc_type)[0]
        for extensions in (None, Extensions(block=DenseBlock))
    )
    assert apart(own, known) <= 1e-7


def test_what_it_refuses_is_raised_on_all_ranks():
    def refuses(data):
        raise InputError(f"{data.name}: not for me")

    p = problem(decomposed("quadrilateral", 4, 4), extensions=Extensions(block=refuses))
    with pytest.raises(InputError, match=r"subdomain \d: not for me"):
        p.solve()
