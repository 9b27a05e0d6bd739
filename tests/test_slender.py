"""Slender cantilevers are as in beam theory, whether they touch or not."""

import numpy as np
import pytest
from bodies import boxes, pressed, two_body_problem
from scenes import clamp, displacement, hooke

import tfeti_dolfinx as tfeti

E, NU, LOAD = 1.0, 0.3, 1e-7  # of load: so much in all that the beam bends a little
PLATE = E / (1.0 - NU**2)  # modulus of bending in plane strain
SHEAR = 5.0 / 6.0 * E / (2.0 * (1.0 + NU))


def free_tip(kind, length):
    """Deflection of a beam of unit height by a unit load in all (Timoshenko)."""
    if kind == "tip":
        return 4.0 * length**3 / PLATE + length / SHEAR
    return 1.5 * length**3 / PLATE + 0.5 * length / SHEAR


class Cantilever:
    """One beam over a plane, or one on another, clamped on the left, loaded from above.

    Args:
        kind: Load: "tip", on the right end, or "uniform", on the top.
        length: Length over height.
        gap: Height over the plane, or over the other beam, as a share of the free deflection;
            None: no contact.
        stacked: Whether there is another beam.
        degree: Of the displacement.
        subdomains: Their number.
        options: For the solver.
    """

    def __init__(self, kind, length, gap, stacked=False, degree=2, subdomains=8, **options):
        self.kind, self.length, self.stacked = kind, length, stacked
        self.tip = LOAD * free_tip(kind, length)
        self.gap = None if gap is None else gap * self.tip
        apart = self.gap or 0.0
        beam = ("beam", (0.0, apart), (float(length), 1.0 + apart), (2 * length, 2))
        other = ("other", (0.0, -1.0), (float(length), 0.0), (2 * length, 2))
        mesh, tags, names = boxes("quadrilateral", [beam, other] if stacked else [beam])
        d = tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces=names)
        loaded, area = ("beam right", 1.0) if kind == "tip" else ("beam top", float(length))
        clamped = ["beam left", "other left"] if stacked else ["beam left"]
        self.problem = two_body_problem(
            d,
            pressed(d, LOAD / area, loaded),
            lambda V: [clamp(V, d.facets(side)) for side in clamped],
            self._contacts(),
            degree,
            hooke(E, NU),
            **options,
        )

    def _contacts(self):
        if self.gap is None:
            return []
        if self.stacked:
            return [tfeti.Contact("beam bottom", "other top", reach=np.inf)]
        plane = tfeti.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
        return [tfeti.Obstacle("beam bottom", plane, reach=np.inf)]

    def expected(self):
        """Deflection of the loaded beam's tip."""
        if self.gap is None or self.gap > self.tip:
            return self.tip
        if self.stacked:  # both bend alike; the other one by what they share
            return 0.5 * (self.tip + self.gap)
        return self.gap

    def solve(self):
        """Solve; returns the tip's deflection."""
        self.problem.solve()
        x, u = displacement(self.problem)
        low = (self.gap or 0.0) - 1e-9
        return -u[np.isclose(x[:, 0], self.length) & (x[:, 1] > low)][:, 1].max()


@pytest.mark.parametrize(
    ("kind", "length", "gap", "stacked", "degree", "subdomains"),
    [
        ("tip", 20, 0.5, False, 1, 16),
        ("uniform", 40, 0.5, False, 2, 2),
        ("uniform", 40, 2.0, True, 2, 8),
        ("tip", 20, 0.0, True, 2, 16),
    ],
)
def test_tips_of_cantilevers(kind, length, gap, stacked, degree, subdomains):
    scene = Cantilever(kind, length, gap, stacked, degree, subdomains)
    tip = scene.solve()
    assert (scene.problem.report.active_contacts > 0) == (gap < 1.0)
    if degree == 2:  # bilinear quadrilaterals are too stiff in bending
        assert np.isclose(tip, scene.expected(), rtol=0.01)
    scene.problem.destroy()


def test_contact_that_never_touches_costs_what_no_contact_costs():
    """Two multiplications more at most, however far the plane is."""
    free, far = (Cantilever("tip", 20, gap, degree=1, subdomains=16) for gap in (None, 100.0))
    tips = [scene.solve() for scene in (free, far)]
    report = far.problem.report
    assert report.contact_rows > 0 == report.active_contacts
    assert report.F_multiplications <= free.problem.report.F_multiplications + 2
    assert np.isclose(*tips, rtol=1e-5)
    for scene in (free, far):
        scene.problem.destroy()


def test_a_propped_cantilever_presses_as_beams_do():
    """The tip of a beam under uniform load rests on the plane: 3/8 of the load, less by the gap."""
    scene = Cantilever("uniform", 40, 0.5)
    scene.problem.solve()
    force = scene.problem.solution.body_forces.force.sum(axis=0)
    assert np.isclose(force[1], 3.0 / 16.0 * LOAD, rtol=0.01)
    scene.problem.destroy()
