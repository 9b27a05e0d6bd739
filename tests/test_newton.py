"""Block Newton against an independent active-set solution, against SMALSE-M, and its price."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from test_qp import bounds_on, matrix, random_program, vector

from tfeti_dolfinx.qp.coarse import DenseCoarse
from tfeti_dolfinx.qp.homogenised import homogenise, image
from tfeti_dolfinx.qp.newton import first_point, newton
from tfeti_dolfinx.qp.problem import QP
from tfeti_dolfinx.qp.stopping import ResidualRule


def solved(F, d, G, e, bounded, tolerance=1e-10):
    coarse = DenseCoarse(G, e)
    qp = QP(matrix(F), vector(d), coarse, bounds_on(bounded))
    start = homogenise(qp, image(qp.F, first_point(qp)))
    return newton(qp, start, ResidualRule(tolerance), max_it=2000)


@pytest.mark.parametrize("seed", range(20))
def test_small(seed):
    F, d, G, e, bounded = random_program(seed)
    result = solved(F, d, G, e, bounded)
    lam, s = result.lam.array_r, result.gradient.array_r
    print(result.reason.name, result.steps)
    assert result.reason > 0
    assert np.allclose(G @ lam, e, atol=1e-10)
    assert lam[bounded].min() >= 0
    assert s[bounded].min() >= -1e-8
