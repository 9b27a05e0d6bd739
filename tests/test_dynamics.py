"""Bodies with mass: identities of the step, and motions that have closed forms."""

import numpy as np
import pytest
from moving import Thrown


def largest(comm, values):
    return comm.allreduce(float(np.abs(values).max(initial=0.0)), op=max)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
@pytest.mark.parametrize("stabilised", [False, True])
def test_free_flight_is_exact(cell, stabilised):
    """A rigid motion under a constant force is a parabola: the rule is exact for it."""
    scene = Thrown(cell, 3, gap=5.0, stabilised=stabilised, weight=0.5, thrown=(0.3, 0.1, 0.0))
    scene.step(0.125, 4)
    comm = scene.problem.decomposition.comm
    u = scene.problem.u.x.array.reshape(-1, scene.gdim)
    assert largest(comm, u[:, -1] + 0.3 * 0.5 + 0.5 * 0.5**2 / 2) <= 1e-12
    assert largest(comm, u[:, 0] - 0.1 * 0.5) <= 1e-12
    v = scene.problem.solution.velocity.x.array.reshape(-1, scene.gdim)
    assert largest(comm, v[:, -1] + 0.3 + 0.5 * 0.5) <= 1e-12


IDENTITIES = [
    (cell, below, stabilised)
    for cell, below in [("quadrilateral", False), ("triangle", True), ("tetrahedron", False)]
    for stabilised in (False, True)
]


@pytest.mark.parametrize(("cell", "below", "stabilised"), IDENTITIES)
def test_the_energy_changes_by_what_was_done(cell, below, stabilised):
    """In each step, through an impact and after it, under a load that changes.

    What contact takes is its force times the gap that it closes, λᵀ(g − Bu).
    """
    scene = Thrown(cell, 3, below=below, stabilised=stabilised, weight=0.02)
    comm, gaps = scene.problem.decomposition.comm, None
    impacts, most = 0, 0.0
    for n in range(12):
        scene.weight.value[0] = 0.01 * n
        ((motion, forces),) = scene.step(0.1)
        solution = scene.problem.solution
        most = max(most, motion["energy"])
        assert abs(motion["defect"]) <= 1e-12 * most
        assert abs(motion["supports"]) <= 1e-8 * most
        assert motion["friction"] == 0.0
        assert motion["predictor"] <= 1e-8 * most
        if gaps is not None:
            closed = comm.allreduce(float(solution.force @ gaps))
            assert motion["contact"] == pytest.approx(-closed, rel=0, abs=1e-8 * most)
            assert closed >= -1e-8 * most
        gaps = np.array(solution.remaining_gap)
        impacts += abs(forces[-1][-1]) > 0.0
    assert impacts >= 2
