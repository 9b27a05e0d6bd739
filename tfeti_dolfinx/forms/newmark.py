"""Forms of bodies with mass: what a step of Newmark's trapezoidal rule solves for.

With τ the step, f the mean load and w = u + τv, or what takes its place,

    (K/2 + 2M/τ²) u⁺ = f + 2Mw/τ² − Ku/2 − Bᵀλ,    v⁺ = v + 2(u⁺ − w)/τ.

It is half of what the literature has, so that λ are forces: their mean in the step.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import ufl
from dolfinx import fem
from scipy.sparse import csr_array
from ufl.algorithms import estimate_total_polynomial_degree

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import assemble_csr
from tfeti_dolfinx.common.parallel import largest
from tfeti_dolfinx.common.validation import POSITIVE, Range, check_stiffness, checked_number
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.forms.assembly import Data, Forms, Load, data_of
from tfeti_dolfinx.forms.checks import check_form, check_same_space, displacement_space
from tfeti_dolfinx.forms.elasticity import Modulus, in_ufl
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs

STEP = Range(
    "a positive number whose square is one, too",
    lambda size: size > 0.0 and 0.0 < size * size < np.inf,
)

log = logging.getLogger(__name__)


@dataclass
class Motion:
    """State at the begin of a time step. Arrays are this rank's, in DOLFINx's numbering."""

    u: Array  # displacement
    v: Array  # velocity
    load: Array  # load
    # w, where the bodies would be without forces: u + τv, or a predictor
    predicted: Array = field(default_factory=lambda: np.zeros(0))
    time_step: float = 0.0  # the step τ, 0 before it is known
    # velocity that the step starts with: v, or what a predictor makes of it
    start_velocity: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def free(self) -> Array:
        """u + τv."""
        return self.u + self.time_step * self.v


class Inertia:
    """Mass of the bodies, and where a time step begins. Creation and all methods are collective.

    ``compiled`` compiles the form of a name. ``motion`` is where the step begins, ``ends`` the load
    at its end.
    """

    # of the sum of the diagonal: up to it the mass of a translation is 0, as where M has a kernel
    _rounding = 1e-10

    def __init__(
        self,
        mass: ufl.Form,
        V: fem.FunctionSpace,
        decomposition: Decomposition,
        compiled: Callable[[ufl.Form, str], fem.Form],
    ) -> None:
        self._V, self._comm = V, decomposition.comm
        space = displacement_space(mass, decomposition, "mass")
        check_same_space(space, V, "the trial function of mass", "that of a")
        check_form(mass, "mass", V, decomposition)
        self._m, self._M = compiled(mass, "mass"), None
        zero = np.zeros(V.dofmap.index_map.size_local * V.dofmap.index_map_bs)
        self.motion, self.ends = Motion(zero, zero, zero), zero
        motion = self.motion
        self._of_step = Data(lambda: [np.array(motion.time_step)], self._comm)
        self._of_m = data_of(mass, V)
        self._of_motion = Data(lambda: [motion.u, motion.load, motion.predicted], self._comm)

    def take_step(self, size: float, same: float = 1e-9) -> None:
        """Let the next step have a size; another one than the last makes the matrix anew.

        Sizes that differ by a share ``same`` are equal: their times are rounded. Raise an
        InputError unless it is positive and on all ranks the same.
        """
        with agreeing(self._comm, "take_step") as given:
            given["step"] = size = checked_number(size, "step", STEP)
        known = self.motion.time_step
        if abs(size - known) <= same * known:
            return
        if known and self._comm.rank == 0:
            log.warning("the step is now %g, it was %g: all is factored anew", size, known)
        self.motion.time_step = size

    def changes(self, moved: bool) -> set[str]:
        """Return which of ``stiffness`` and ``load`` are new since the last call.

        They are by M, which is assembled anew where the mesh has moved, too, by the step, and by
        the state at its begin.
        """
        data = (self._of_m, self._of_step, self._of_motion)
        new_mass, new_step, new_motion = [part.has_changed() for part in data]
        if new_mass or moved:
            self._M = None
        found = {"stiffness", "load"} if new_mass or new_step else set()
        return found | ({"load"} if new_motion else set())

    @property
    def M(self) -> csr_array:
        """This rank's M in DOLFINx's numbering."""
        if self._M is None:
            M = assemble_csr(self._m)
            with raised_on_all_ranks(self._comm):
                check_stiffness("mass", M, "the matrix", "a density, or a form such as ∫ρ u·v")
                for k in range(bs := self._V.dofmap.index_map_bs):
                    along = np.zeros(M.shape[0])
                    along[k::bs] = 1.0
                    total, sizes = along @ (M @ along), M.diagonal() @ along
                    if total <= self._rounding * sizes and len(along):
                        raise InputError(
                            f"mass: a translation along {'xyz'[k]} has the mass {total:.3g}; "
                            "expected a density, or a form such as ∫ρ u·v"
                        )
            self._M = M
        return self._M

    @property
    def share(self) -> float:
        """2/τ²."""
        if not self.motion.time_step:
            raise InputError("the step has no size yet; expected a call of take_step(size) before")
        return 2.0 / self.motion.time_step**2

    def move(self, u: Array, v: Array, load: Array | None = None) -> None:
        """Let the next step begin at a displacement and a velocity, and with the last load."""
        motion = self.motion
        motion.u, motion.v, motion.start_velocity = u, v, v
        motion.load = self.ends if load is None else load


class InertialForms(Forms):
    """The matrix and the load of a step. Creation and all methods are collective.

    The arguments are those of ``Forms``; L is the load as it is at the end of the step. ``inertia``
    has M, and where the step begins.
    """

    has_mass: ClassVar[bool] = True

    def __init__(self, mass: ufl.Form, *as_forms: Any) -> None:
        super().__init__(*as_forms)
        self.inertia = Inertia(mass, self._V, self._decomposition, self._compiled)
        self.inertia.ends = self._linear()
        self.given = {**self.given, "mass": mass}
        self._K: csr_array | None = None

    def changes(self, *kept: str) -> set[str]:
        """Return what is new, by inertia, too; a new matrix makes a new load."""
        found = super().changes(*kept)
        if found & {"points", "stiffness"}:
            self._K = None
        found |= self.inertia.changes("points" in found)
        return found | {"load"} if "stiffness" in found else found

    @property
    def K(self) -> csr_array:
        """This rank's K in DOLFINx's numbering."""
        if self._K is None:
            self._K = super().stiffness()
        return self._K

    def stiffness(self) -> Any:
        """Return this rank's K/2 + 2M/τ²."""
        return 0.5 * self.K + self.inertia.share * self.inertia.M

    def load(self) -> Load:
        """Return this rank's f + 2Mw/τ² − Ku/2."""
        inertia = self.inertia
        motion, inertia.ends = inertia.motion, self._linear()
        pull = inertia.M @ motion.predicted * inertia.share
        return Load(0.5 * (motion.load + inertia.ends) + pull - 0.5 * (self.K @ motion.u))

    def elastic(self, u: Array) -> float:
        """Return this rank's part of uᵀKu/2."""
        return float(0.5 * u @ (self.K @ u))


def check_copies(values: Array, dofs: TornDofs, name: str, left: float = 1e-3) -> None:
    """Raise an InputError where torn copies of a node differ, or a value is not finite. Collective.

    The values are in DOLFINx's order; ``left`` is the share of the largest one by which a solver
    may have left them apart.
    """
    primal = dofs.to_primal(np.asarray(values)).reshape(-1, dofs.bs)
    with raised_on_all_ranks(dofs.comm):
        if not np.all(np.isfinite(primal)):
            raise InputError(f"{name} has values that are not finite numbers")
    most = dofs.reduce(primal, np.maximum)
    apart = dofs.spread(most - dofs.reduce(primal, np.minimum)).max(axis=1, initial=0.0)
    allowed = left * largest(dofs.comm, primal)
    with raised_on_all_ranks(dofs.comm):
        if np.any(apart > allowed):
            worst = int(np.argmax(apart))
            x = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node[worst]]
            at = ", ".join(f"{x:.6g}" for x in x[: dofs.bs])
            raise InputError(
                f"{name} differs by {apart[worst]:.3g} between torn copies of the node at ({at}); "
                "expected a continuous function on each body"
            )


def mass_form(
    density: Modulus,
    V: fem.FunctionSpace,
    decomposition: Decomposition,
    thickness: Any,
    lumped: bool,
) -> ufl.Form:
    """Return ∫ρ u·v, times the thickness. Collective.

    The density is a number, a scalar in UFL, or numbers for all volumes by names. Lumped, it is
    integrated at the vertices, which makes M diagonal; elements of another degree than 1 raise an
    InputError then.
    """
    rho = in_ufl(density, decomposition, "mass", POSITIVE)
    degree = V.element.basix_element.degree
    if lumped and degree != 1:
        raise InputError(f"lumped=True on elements of degree {degree}; expected degree 1")
    is_one = isinstance(thickness, float) and thickness == 1.0
    per_area = rho if is_one else thickness * rho
    rule = {"quadrature_degree": 2 * degree + int(estimate_total_polynomial_degree(per_area))}
    if lumped:
        rule = {"quadrature_rule": "vertex", "quadrature_degree": 1}
    dx = ufl.Measure("dx", domain=decomposition.mesh, metadata=rule)
    return per_area * ufl.inner(ufl.TrialFunction(V), ufl.TestFunction(V)) * dx
