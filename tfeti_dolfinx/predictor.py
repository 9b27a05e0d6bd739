"""Where bodies with mass may be without elasticity: the nearest place in M that contact allows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.extensions import Extensions, Settings
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.gluing.glue import Gluing
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.qp.discs import Discs
from tfeti_dolfinx.qp.feasible_sets import Bounds, FeasibleSet, Product
from tfeti_dolfinx.solver import conclude, resolve_types, solve_dual
from tfeti_dolfinx.subdomains.build import make_subdomains, subdomain_data
from tfeti_dolfinx.subdomains.data import Counters
from tfeti_dolfinx.subdomains.factor import added_options
from tfeti_dolfinx.subdomains.subdomains import Subdomains


class Predictor:
    """argmin ‖u − w‖_M over the u that rows allow, without friction.

    A quadratic program with the mass M as stiffness and the rows of the problem. Prescribed
    components are held where w has them; contacts meet them where they are at the end of the step:
    where w has them they may overlap, though nothing does at the end. Creation and all methods are
    collective.

    Args:
        dofs: Dof maps.
        decomposition: The torn mesh.
        settings: How to solve.

    Attributes:
        multiplications: By F of the mass in the last call.
    """

    def __init__(self, dofs: TornDofs, decomposition: Decomposition, settings: Settings) -> None:
        self._dofs, self._decomposition = dofs, decomposition
        options = replace(settings.options, recycle=0)  # of a mass there is little to learn
        self._settings = replace(settings, extensions=Extensions(), options=options)
        self._M: csr_array | None = None
        self._subdomains: Subdomains | None = None
        self._dual: Dual | None = None
        self._start: tuple[Gluing, Array] | None = None
        self._image: Array = np.zeros(0)
        self.multiplications = 0

    @property
    def start(self) -> tuple[Array, Array]:
        """Multipliers that the next call starts from, and their image. Collective.

        Empty before the first, or where the image is not known.
        """
        if self._start is None or self._dual is None:
            return np.zeros(0), np.zeros(0)
        return self._start[1], self._dual.last.known(self._dofs.comm, self._start[1])

    def start_from(self, gluing: Gluing, lam: Array, image: Array) -> None:
        """Let the next call start from multipliers of some rows, as ``start`` had them."""
        self._start, self._image = (gluing, lam), image

    def nearest(self, w: Array, M: csr_array, gluing: Gluing) -> Array:
        """The nearest displacement to w.

        Args:
            w: Displacement in DOLFINx's order.
            M: This rank's mass in DOLFINx's order; factors are kept while it is the same object.
            gluing: Rows and their right sides, which are as before afterwards.

        Returns:
            A displacement in DOLFINx's order.

        Raises:
            ConvergenceError: The solver stopped before its tolerance.
            FactorError: M could not be factored.
        """
        dofs, constraints = self._dofs, gluing.constraints
        before, primal = np.array(constraints.c.array_r), dofs.to_primal(w)
        total = dofs.reduce(primal.reshape(-1, dofs.bs), np.add, 0.0)
        held = total / dofs.multiplicity[:, None]
        constraints.set_right_side(gluing.with_supports_at(held))
        try:
            self._make(M, M @ w, gluing)
            return dofs.to_dolfinx(self._solve(gluing))
        finally:
            constraints.set_right_side(before)

    def _make(self, M: csr_array, f: Array, gluing: Gluing) -> None:
        """Make what is out of date."""
        constraints, settings = gluing.constraints, self._settings
        new_rows = self._dual is None or self._dual.constraints is not constraints
        if M is not self._M:
            self.destroy()
            counters = Counters()
            data = subdomain_data(self._dofs, self._decomposition, M.copy(), f, constraints.trace)
            with added_options(settings.prefix, settings.factor_options):
                self._subdomains = make_subdomains(
                    data,
                    settings.make_block(counters),
                    self._decomposition,
                    counters,
                    settings.local_choice,
                )
            self._M, new_rows = M, True
        assert self._subdomains is not None
        self._subdomains.update(f=self._dofs.to_primal(f))
        if not new_rows and self._dual is not None:
            self._dual.update_load()
            return
        if self._dual is not None:
            self._dual.destroy()
            self._subdomains.retrace(constraints.trace, constraints.span)
        scene = self._dofs, self._decomposition
        self._dual = settings.make_dual(constraints, self._subdomains, *scene, _frictionless)

    def _solve(self, gluing: Gluing) -> Array:
        """The displacement in primal order."""
        dual, options, start = self._dual, self._settings.options, None
        assert dual is not None
        dual.forget_counts()
        if self._start is not None:  # nothing has a kernel in M
            start = (gluing.multipliers(*self._start), np.zeros(0))
            if self._start[0] is gluing:
                dual.last.take(self._dofs.comm, self._start[1], self._image)
        self._image = np.zeros(0)  # it is of the F and the start of a restored state alone
        qp_type, _ = resolve_types(options, dual.contact_rows, self._settings.prefix)
        result, accuracy = solve_dual(dual, options, qp_type, start)
        self._start = (gluing, np.array(result.lam.array_r)) if result.reason > 0 else None
        self.multiplications = dual.F.count["solver"]
        result.destroy()
        conclude(result, accuracy, options, self._dofs.comm)
        return accuracy.u

    def destroy(self) -> None:
        """Destroy the PETSc objects; the next call makes them anew."""
        for item in (self._dual, self._subdomains):
            if item is not None:
                item.destroy()
        self._M = self._dual = self._subdomains = None


def _frictionless(constraints: Constraints) -> FeasibleSet:
    """λ_N ≥ 0, and no force along tangents."""
    sets = constraints.sets
    none, width = np.zeros(len(sets.tangents)), sets.tangents.shape[1]
    return Product([(sets.normals, Bounds()), (sets.tangents.ravel(), Discs(none, width))])
