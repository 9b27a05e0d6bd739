"""Laws of friction as the user gives them, and their values at contact nodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from numbers import Real
from typing import Any, ClassVar, TypeAlias

import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.common.arrays import Array, ArrayLike
from tfeti_dolfinx.common.validation import (
    FINITE,
    Range,
    checked_number,
    checked_vector,
    shown,
    values_at,
)
from tfeti_dolfinx.contact.records import ContactRecords, Friction
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import group_points
from tfeti_dolfinx.mortar.segments import aligned
from tfeti_dolfinx.mortar.tolerances import SEARCH

Value: TypeAlias = "float | Callable[[Array], ArrayLike] | fem.Function | fem.Constant"

NOT_NEGATIVE = Range("a number, 0 or more", lambda value: value >= 0.0)


def is_of_points(what: str, value: Any) -> bool:
    """Return whether a ``Value`` may vary; raise an InputError where it is no scalar one."""
    if isinstance(value, (fem.Function, fem.Constant)):
        if value.ufl_shape != ():
            raise InputError(f"{what} has the shape {value.ufl_shape}; expected a scalar")
        return True
    if isinstance(value, ufl.core.expr.Expr):  # which can be called, with points
        raise InputError(
            f"{what} is {shown(value)}; expected a number, a function of points of shape (3, n), a "
            "dolfinx.fem.Constant, or a scalar dolfinx.fem.Function, into which UFL can be "
            "interpolated"
        )
    return callable(value)


class FrictionLaw:
    """One or two values of a bound on the tangential traction; where it is 0, points only touch."""

    what: ClassVar[str]  # name of the attribute that has the values
    kind: ClassVar[Friction]
    direction: Sequence[float] | None  # along which the first of two values holds

    def __post_init__(self) -> None:
        what, count = f"{type(self).__name__}: {self.what}", len(self.values)
        if count not in (1, 2) or (count == 2) != (self.direction is not None):
            raise InputError(
                f"{what} has {count} value{'s' * (count != 1)} and direction={self.direction!r}; "
                "expected one value, or two and the direction of the first"
            )
        for value in self.values:
            if not is_of_points(what, value):
                checked_number(value, what, NOT_NEGATIVE)

    @property
    def values(self) -> tuple[Value, ...]:
        """One value, or two."""
        given = getattr(self, self.what)
        return tuple(given) if isinstance(given, (tuple, list)) else (given,)

    def is_same_as(self, other: FrictionLaw) -> bool:
        """Return whether two laws are the same, as far as one can tell without calling them."""
        values = [*zip(self.values, other.values, strict=False)]
        return (
            type(self) is type(other)
            and len(self.values) == len(other.values)
            and all(a is b or (not callable(a) and a == b) for a, b in values)
            and repr(self.direction) == repr(other.direction)
        )


@dataclass(frozen=True)
class Tresca(FrictionLaw):
    """The tangential traction is at most a bound, whatever the pressure is.

    It acts on all nodes with a contact condition within reach, open ones as well, and on those
    whose normal displacement is prescribed.

    Args:
        bound: A stress, 0 or more: a number, a function of points of shape ``(3, n)``, a DOLFINx
            constant, or a scalar DOLFINx function on the torn mesh. Two of them: orthotropic, along
            the direction and across it; the traction is in the ellipse with these semi-axes.
        direction: Vector along which the first of two bounds holds, projected on the surface.

    Raises:
        InputError: A bound is negative or no bound, or a direction is missing or too much.

    Example:
        >>> tfeti.Tresca((0.02, 0.01), direction=(1, 0, 0)).values
        (0.02, 0.01)
    """

    bound: Value | tuple[Value, Value]
    _: KW_ONLY
    direction: Sequence[float] | None = None

    what = "bound"
    kind = Friction.GIVEN


@dataclass(frozen=True)
class Coulomb(FrictionLaw):
    """The tangential traction is at most a coefficient times the pressure.

    Nodes whose normal displacement is prescribed have no friction: their contact force is hidden
    in what holds them.

    Args:
        coefficient: 0 or more: a number, a function of points of shape ``(3, n)``, a DOLFINx
            constant, or a scalar DOLFINx function on the torn mesh. Two of them: orthotropic, along
            the direction and across it; the traction over the pressure is in the ellipse with these
            semi-axes.
        direction: Vector along which the first of two coefficients holds, projected on the
            surface.

    Raises:
        InputError: A coefficient is negative or no coefficient, or a direction is missing or too
            much.

    Example:
        >>> tfeti.Coulomb(0.3).values
        (0.3,)
    """

    coefficient: Value | tuple[Value, Value]
    _: KW_ONLY
    direction: Sequence[float] | None = None

    what = "coefficient"
    kind = Friction.COULOMB


def with_friction(
    name: str, friction: FrictionLaw | None, records: ContactRecords, dofs: TornDofs
) -> ContactRecords:
    """Give a contact's conditions its friction, and tangents along its direction. Collective."""
    if friction is None:
        return records
    gdim = dofs.bs
    if gdim == 1:
        raise InputError(
            f"{name}: friction on a scalar space; expected displacements, since what slides needs "
            "tangents"
        )
    if friction.direction is not None:
        if gdim == 2:
            raise InputError(
                f"{name}: {friction.what} has two values; expected one in the plane, where there "
                "is one tangent"
            )
        expected = "three numbers, not all of them 0"
        direction = checked_vector(friction.direction, f"{name}: direction", [3], expected)
        if not np.any(direction):
            raise InputError(f"{name}: direction={shown(friction.direction)}; expected {expected}")
        direction = direction / np.linalg.norm(direction)
        with raised_on_all_ranks(dofs.comm):
            frame, left = aligned(records.frame, direction)
            if np.any(left < SEARCH.along):
                x = group_points(dofs)[records.group[np.argmin(left)]]
                raise InputError(
                    f"{name}: direction {friction.direction} is along the normal at the node "
                    f"{x.tolist()}; expected one that is along the surface everywhere"
                )
        records = replace(records, frame=frame)
    return replace(records, friction=np.full(len(records), friction.kind))


def friction_values(
    name: str, friction: FrictionLaw | None, records: ContactRecords, dofs: TornDofs
) -> Array:
    """Bounds or coefficients along tangents, ``(n, gdim - 1)``, 0 without a law. Collective."""
    if friction is None:
        return np.zeros((len(records), dofs.bs - 1))
    what, group = f"{name}: {friction.what}", records.group
    columns = [values_on(what, value, group, dofs, lowest=0.0) for value in friction.values]
    if len(columns) < dofs.bs - 1:
        columns = columns * (dofs.bs - 1)
    return np.stack(columns, axis=1)


def values_on(
    what: str, value: Any, group: Array, dofs: TornDofs, lowest: float = -np.inf
) -> Array:
    """Return the number that a ``Value`` has at each of these groups of nodes. Collective.

    Raise an InputError where a function fails or is on another mesh, or a number is not finite or
    below the lowest.
    """
    if isinstance(value, fem.Function):  # the mean over torn copies
        S, dof = dofs.scalar
        if value.function_space.mesh._cpp_object is not S.mesh._cpp_object:
            raise InputError(
                f"{what} is on another mesh; expected a function on decomposition.mesh, the torn "
                "mesh, where decomposition.from_original takes functions"
            )
        on_nodes = fem.Function(S)
        on_nodes.interpolate(value)
        total = dofs.reduce(on_nodes.x.array[dof], np.add)
        value = (total / dofs.multiplicity)[group]
    elif isinstance(value, fem.Constant):
        value = value.value
    x = np.zeros((len(group), 3)) if isinstance(value, Real) else group_points(dofs)[group]
    with raised_on_all_ranks(dofs.comm):
        if callable(value):
            value = values_at(value, x.T, (len(x),), f"{what} at")
        values = np.array(np.broadcast_to(value, (len(x),)), dtype=float)
        if np.any(wrong := ~(np.isfinite(values) & (values >= lowest))):
            expected = FINITE if lowest < 0.0 else NOT_NEGATIVE
            raise InputError(
                f"{what} is {values[wrong][0]} at the point {x[wrong][0].tolist()}; expected "
                f"{expected.text}"
            )
    return values
