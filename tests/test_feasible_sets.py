"""Feasible sets keep their contract, products of them too, and what does not is named."""

from dataclasses import replace

import numpy as np
import pytest
from test_discs import discs

from tfeti_dolfinx import InputError
from tfeti_dolfinx.errors import ConformanceError
from tfeti_dolfinx.qp.sets import Bounds, Ellipses, Face, Product, Status
from tfeti_dolfinx.testing import check_feasible_set

pytestmark = pytest.mark.usefixtures("serial_only")

LOWER = Bounds(np.linspace(-2.0, 2.0, 17))


@pytest.mark.parametrize(
    "feasible",
    [Bounds(), Product(), Product([(slice(3, 20), LOWER)]), Product([(slice(0, 0), Bounds())])],
)
def test_feasible_sets_fulfil_their_contract(feasible):
    check_feasible_set(feasible, 30)


def friction(seed=0):
    """Equalities, normals and discs on rows in no order, as a contact law would put them."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(20)
    normals, tangents = order[5:10], order[10:]
    radius = rng.uniform(0.5, 2.0, 5)
    return Product([(normals, Bounds()), (tangents, discs(radius))]), normals, tangents


def test_the_face_of_a_product_says_what_each_row_does():
    feasible, normals, tangents = friction()
    rng = np.random.default_rng(1)
    x, g = feasible.project(1.2 * rng.standard_normal(20)), rng.standard_normal(20)
    face = feasible.face(x, g)
    assert np.array_equal(face.status[normals] == Status.OPEN, x[normals] == 0.0)
    slip = face.status[tangents] == Status.SLIP
    assert 0 < slip.sum() < 10
    assert np.array_equal(face.carrying, face.status != Status.OPEN)
    assert np.array_equal(face.carrying & ~face.holding, face.status == Status.SLIP)
    bounded = np.isin(np.arange(20), np.r_[normals, tangents])
    assert np.array_equal(face.status != Status.FREE, bounded)
    assert face.Z.shape[1] == face.holding.sum() + slip.sum() // 2
    y = face.restricted(rng.standard_normal(20))
    assert np.allclose(face.restricted(y), y)
    assert np.all(y[face.status == Status.OPEN] == 0.0)
    pairs = (x * y)[tangents].reshape(-1, 2).sum(axis=1)  # on circles only around the centre
    assert np.allclose(pairs[slip[::2]], 0.0)


def test_a_row_in_two_sets_is_named():
    with pytest.raises(InputError, match="Product: constraint 4 stands in two sets; expected one"):
        Product([(slice(0, 5), Bounds()), (np.array([7, 4]), Bounds())])


def broken(base=Bounds, *given, **methods):
    """A set of which some methods are others."""
    return type("Broken", (base,), methods)(*given)


def scaled(self, x, g):
    face = Bounds.face(self, x, g)
    rows = np.flatnonzero(face.free)[:, None]
    twice, flat = np.full(rows.shape, 2.0), np.zeros(len(rows))
    return Face(np.zeros_like(face.free), face.status, rows, twice, flat, face.beta)


class WithoutOnto:
    project, max_step, face = Bounds.project, Bounds.max_step, Bounds.face


def free_or_not(make):
    """A face whose rows are all free, or none."""
    return lambda self, x, g: replace(Bounds.face(self, x, g), free=make(len(x), dtype=bool))


def touching(self, x, g):
    return Face(np.ones(len(x), dtype=bool), np.full(len(x), Status.TOUCHING), beta=0.0 * g)


def never(self, x, g):
    return replace(Bounds.face(self, x, g), beta=0.0 * g)


def below(self, x, status):
    return np.where(status == Status.OPEN, self.lower - 1.0, self.project(x))


def flat(self, x, g):
    face = Ellipses.face(self, x, g)
    return replace(face, curvature=0.0 * face.curvature)


LETS_GO = {"onto": lambda self, x, status: self.project(x)}
WRONG = [
    (r"P\(x\) is the nearest point", broken(project=lambda self, x: np.abs(x))),
    (
        r"P\(P\(x\)\) = P\(x\)|nearest point",
        broken(project=lambda self, x: np.where(x > 0, x, x / 2)),
    ),
    ("largest step", broken(max_step=lambda self, x, p: 2.0 * Bounds.max_step(self, x, p))),
    (r"φ \+ β is the projected gradient", broken(face=never)),
    ("open rows are not in Z", broken(face=free_or_not(np.ones))),
    (r"x \+ Zt stays in Ω", broken(face=touching)),
    ("rows that are held are free in Z", broken(face=free_or_not(np.zeros))),
    ("columns of Z are orthonormal", broken(face=scaled)),
    (
        "a status for each row",
        broken(face=lambda self, x, g: replace(Bounds.face(self, x, g), status=np.zeros(0))),
    ),
    ("bends by", broken(Ellipses, np.full((5, 2), 0.05), face=flat)),
    ("onto keeps open rows open", broken(**LETS_GO)),
    (r"onto\(x, status\) ∈ Ω", broken(onto=below)),
    ("onto without bounds is P_Ω", broken(onto=lambda self, x, status: np.array(x))),
    ("slipping ones on their boundary", broken(Ellipses, np.full((5, 2), 1.0), **LETS_GO)),
    ("a FeasibleSet has onto", WithoutOnto()),
]


@pytest.mark.parametrize(("words", "wrong"), WRONG, ids=[words for words, _ in WRONG])
def test_what_does_not_conform_is_named(words, wrong):
    with pytest.raises(ConformanceError, match=words):
        check_feasible_set(wrong, 10)
