"""Parts of one's own through ContactProblem: an inverse, a preconditioner, a kind of subdomain."""

from types import SimpleNamespace

import numpy as np
import pytest
from scenes import apart, curved_obstacle, decomposed, problem
from scipy.linalg import pinvh

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.feti.operator import DualOperator
from tfeti_dolfinx.feti.projectors import FaceFactors, NullModes
from tfeti_dolfinx.feti.stopping import Accuracy, Criterion
from tfeti_dolfinx.subdomains.block import Block, kernel_of
from tfeti_dolfinx.subdomains.local_operators import GroupedOperator
from tfeti_dolfinx.subdomains.subdomains import Subdomains
from tfeti_dolfinx.testing import check_kind_of_block


class DensePinv:
    """K⁺ of Moore and Penrose."""

    def __init__(self, K, R, fixing_dofs, prefix):
        self.inverse = pinvh(K.toarray(), rtol=1e-12)

    def solve(self, b):
        return self.inverse @ b


class Doubled(GroupedOperator):
    """Twice the stiffness of the trace: scales a preconditioner, which changes nothing."""

    def mult(self, w, out):
        super().mult(w, out)
        out *= 2.0


def doubled(B, subdomains):
    return DualOperator(B, Doubled(subdomains.blocks, "stiffness"))


def solved(contacts=(), extensions=None, **options):
    d = decomposed("hexahedron", 3, 4)
    p = problem(d, contacts=contacts, extensions=extensions, tfeti_rtol=1e-9, **options)
    u = p.solve().x.array.copy()
    p.destroy()
    return u, p


def test_a_preconditioner_of_one_s_own():
    known, p = solved(tfeti_pc_type="lumped")
    own, q = solved(extensions=Extensions(preconditioner=doubled))
    assert apart(own, known) <= 1e-7
    assert q.report.preconditioner_multiplications > 0
    assert abs(q.report.cg_steps - p.report.cg_steps) <= 1


def test_subdomains_and_deflation_of_one_s_own():
    """Both are asked for, and what they make is used."""
    asked = []

    def subdomains(dofs, decomposition):
        asked.append("subdomains")
        return Subdomains

    def deflation(B, coarse, weights, prefix):
        asked.append("deflation")
        factors = FaceFactors(coarse.comm, NullModes(coarse.null), prefix)
        own = {"balanced": lambda face, on_face: on_face, "destroy": lambda: None}
        return SimpleNamespace(count=0, factors=factors, **own)

    own = Extensions(subdomains=subdomains, deflation=deflation)
    known, found = (solved(extensions=parts)[0] for parts in (None, own))
    assert asked == ["subdomains", "deflation"]
    assert np.array_equal(found, known)
    with pytest.raises(tfeti.InputError, match="are given, and clusters, .*; expected one of them"):
        solved(extensions=own, tfeti_clusters=2)


def test_a_monitor_of_one_s_own():
    seen = []

    def monitor(steps, step, x, projected_gradient, equality):
        seen.append((step, projected_gradient))

    _, p = solved(extensions=Extensions(monitor=monitor))
    inner = [size for step, size in seen if step == "cg"]
    assert len(inner) == p.report.cg_steps > 3
    assert inner[-1] < 1e-3 * max(inner)


class InEnergy(Accuracy):
    """Stops where the error of u in energy is at most rtol ‖u‖_K."""

    def criteria(self):
        now, rounding = self.measures, self.allowed.rounding
        return {"energy_error": Criterion(now.error, self.rtol * now.energy, rounding, now.energy)}


@pytest.mark.parametrize("law", [None, tfeti.Coulomb(0.5)])
def test_a_stopping_rule_of_one_s_own(law):
    d, own = decomposed("hexahedron", 6, 4), Extensions(stopping=InEnergy)
    floor = [tfeti.Obstacle("bottom", curved_obstacle(3), friction=law)]
    exact, p = (problem(d, contacts=floor, extensions=own, rtol=rtol) for rtol in (1e-9, 1e-3))
    known, u = exact.solve() and exact.solution.u, p.solve() and p.solution.u
    energies, report = p.dual.subdomains.energies, p.report
    off, size = (d.comm.allreduce(sum(energies(v))) ** 0.5 for v in (u - known, known))
    error, allowed = report.residuals["energy_error"], report.tolerances["energy_error"]
    assert off <= min(1.25 * error, allowed) * size
    assert f"energy error {error:.1e} (allowed 1.0e-03)" in str(report)
    assert "displacement_error" not in report.tolerances
    assert report.F_multiplications < exact.report.F_multiplications


class Falling(Accuracy):
    """A rule whose error falls with each look, whatever is found there."""

    seen = 0

    def criteria(self):
        Falling.seen += 1
        return {"own": Criterion(1.0 / Falling.seen, 1.0)}


def test_a_stopping_rule_need_not_know_of_the_target_nor_of_coulomb():
    d, own, costs = decomposed("hexahedron", 6, 4), Extensions(stopping=Falling), []
    for rtol, law in ((1e-2, None), ("auto", None), (1e-2, tfeti.Coulomb(0.5))):
        floor = [tfeti.Obstacle("bottom", curved_obstacle(3), friction=law)]
        p, Falling.seen = problem(d, contacts=floor, extensions=own, rtol=rtol), 0
        p.solve()
        error, allowed = p.report.residuals, p.report.tolerances
        assert {"own", "balance"} < set(allowed)
        assert ("algebraic_error" in allowed) == (rtol == "auto")
        assert all(error[name] <= allowed[name] for name in allowed)
        # of the two looks at an answer with Coulomb's law the larger error
        assert error["own"] == 1.0 / (Falling.seen - (law is not None))
        costs.append(p.report.F_multiplications)
    assert costs[0] < costs[1]
    with pytest.raises(tfeti.InputError, match="stopping gave .* without .*; expected a rule"):
        solved(extensions=Extensions(stopping=lambda *given: None))
    with pytest.raises(tfeti.InputError, match="Old overrides ratio; expected criteria"):
        type("Old", (Accuracy,), {"ratio": lambda self: 0.0})


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
@pytest.mark.parametrize("part", [{"block": DenseBlock}, {"kplus": DensePinv}])
def test_parts_of_a_subdomain_of_one_s_own(part, pc_type):
    floor = [tfeti.Obstacle("bottom", curved_obstacle(3))] if pc_type == "auto" else []
    both = (None, Extensions(**part))
    known, own = (solved(floor, parts, tfeti_pc_type=pc_type)[0] for parts in both)
    assert apart(own, known) <= 1e-7


def test_what_it_refuses_is_raised_on_all_ranks():
    def refuses(data):
        raise InputError(f"{data.name}: not for me")

    p = problem(decomposed("quadrilateral", 4, 4), extensions=Extensions(block=refuses))
    with pytest.raises(InputError, match=r"subdomain \d: not for me"):
        p.solve()
