"""Rigid bodies: shapes that move by a law, or under a force."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from dolfinx import fem
from scipy.spatial.transform import Rotation

from tfeti_dolfinx.common.arrays import Array, ArrayLike
from tfeti_dolfinx.common.validation import (
    POSITIVE,
    checked_flag,
    checked_number,
    checked_type,
    checked_vector,
    named,
    shown,
)
from tfeti_dolfinx.contact.shapes import Placed, Shape, SurfaceMesh, Vector, check_shape
from tfeti_dolfinx.errors import InputError

# numbers that may change: fixed, a constant of DOLFINx, or a function of the problem's time
Law: TypeAlias = "float | Sequence[float] | Array | fem.Constant | Callable[[float], ArrayLike]"

# names of motions by dimension, in the order of a body's candidate modes
MOTIONS = {2: ("x", "y", "rz"), 3: ("x", "y", "z", "rz", "ry", "rx")}

# --- Places of a rigid body -------------------------------------------------------------------


def motion_fields(arm: Array) -> Array:
    """Return the displacements of points by unit translations and small unit turns.

    Points are counted from the centre of the turns, shape ``(n, gdim)``. In the order of
    ``MOTIONS``, shape ``(n, k, gdim)``.
    """
    n, gdim = arm.shape
    fields = np.zeros((n, len(MOTIONS[gdim]), gdim))
    fields[:, :gdim] = np.eye(gdim)
    if gdim == 2:
        fields[:, 2] = np.stack((-arm[:, 1], arm[:, 0]), axis=1)
    else:
        fields[:, 3:] = np.cross(np.eye(3)[::-1], arm[:, None])
    return fields


@dataclass(frozen=True)
class Pose:
    """Place of a rigid body, which takes X to p + Q(X − p) + t."""

    point: Array  # p, shape (gdim,)
    motion: Array  # t and the rotation vector of Q in the order of `MOTIONS`, shape (k,)
    finite: bool  # whether Q is a rotation; else the small one 1 + [θ]×

    @property
    def centre(self) -> Array:
        """The point p at this place."""
        return np.asarray(self.point + self.motion[: len(self.point)])

    @property
    def rotation(self) -> Array:
        """Q, shape ``(gdim, gdim)``."""
        turn = rotation_vector(self.motion, len(self.point))
        small = np.eye(3) + np.cross(turn, np.eye(3)).T  # a ↦ a + turn × a
        Q = Rotation.from_rotvec(turn).as_matrix() if self.finite else small
        return np.asarray(Q[: len(self.point), : len(self.point)])

    def displacement(self, X: Array) -> Array:
        """Displacement of the body's points X, shape ``(n, gdim)``."""
        turned = (X - self.point) @ (self.rotation - np.eye(len(self.point))).T
        return np.asarray(self.motion[: len(self.point)] + turned)

    def way_to(self, x: Array) -> Array:
        """Displacement of the body's points that are at x, shape ``(n, gdim)``."""
        gdim = len(self.point)
        back = np.linalg.inv(self.rotation)
        return np.asarray((x - self.point) @ (np.eye(gdim) - back).T + back @ self.motion[:gdim])

    def moved(self, step: Array) -> Pose:
        """Pose after one more motion, turns about the centre."""
        motion, gdim = self.motion + step, len(self.point)
        if self.finite and gdim == 3:
            turns = [Rotation.from_rotvec(rotation_vector(q, 3)) for q in (step, self.motion)]
            motion[3:] = (turns[0] * turns[1]).as_rotvec()[::-1]
        return replace(self, motion=motion)


def rotation_vector(motion: Array, gdim: int) -> Array:
    """Return the rotation vector of a motion, shape ``(3,)``."""
    return np.array((0.0, 0.0, motion[2])) if gdim == 2 else motion[:2:-1]


# --- Rigid bodies as a user gives them --------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A rigid tool: a shape that moves by a law, or under a force.

    It stands where an obstacle has its shape. Motions are translations ``"x"``, ``"y"``,
    ``"z"`` and turns about axes through ``point``: ``"rz"`` in 2D, ``"rx"``, ``"ry"``, ``"rz"``.
    Those in ``free`` are found, so that contact balances force and moment; others are those of
    the law. Surfaces that touch it are its bearings: a tool of several obstacles is one body.

    Numbers may be fixed, a ``dolfinx.fem.Constant``, or a function of ``ContactProblem.time``,
    which ``LoadSteps`` sets. Another value needs neither constraints nor factors.

    Args:
        shape: Its shape where the motion is 0: as of an ``Obstacle``.
        displacement: Of ``point``, gdim components; default 0.
        rotation: About ``point``: an angle in 2D, a rotation vector of three components in 3D;
            in radians.
        force: On the body, gdim components; with a thickness, on all of it.
        moment: About ``point``: a number in 2D, three components in 3D.
        free: Names of the motions that are free.
        mass: Of the body, in a ``ContactDynamics``, where free motions need it.
        inertia: Moments of inertia about the axes through ``point``, which is the centre of mass
            then: a number in 2D, three in 3D (of the axes x, y, z); where turns are free.
        velocity: That of ``point`` at the start of a ``ContactDynamics``, gdim components, along
            free motions; default 0.
        point: Default the centre or the point of the shape, else the origin.
        name: For messages and ``solution.tool(name)``. Default: "tool of surface 'a'".
        large: Whether its motion is not small compared with the shape: then its shape is placed
            where the law has it before each solve, and contact is searched there. Else gaps change
            with the motion, and normals stay.

    Raises:
        InputError: Something given does not fit; the message names it.

    Example:
        >>> ball = tfeti.Sphere((0, 0, 1), radius=1.0)
        >>> tfeti.RigidBody(ball, force=(0, 0, -2.0), free=("z",), name="indenter").name
        'indenter'
    """

    shape: Shape
    _: KW_ONLY
    displacement: Law | None = None
    rotation: Law | None = None
    force: Law | None = None
    moment: Law | None = None
    free: Sequence[str] = ()
    mass: float | None = None
    inertia: float | Sequence[float] | None = None
    velocity: Sequence[float] | None = None
    point: Vector | None = None
    name: str = ""
    large: bool = False
    _pose: Pose | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        checked_type(self.name, str, "RigidBody: name", "a text")
        what = f"RigidBody {self.name}".rstrip()
        if isinstance(self.shape, RigidBody):
            raise InputError(f"{what}: shape is a RigidBody; expected its shape")
        check_shape(self.shape, what)
        checked_flag(self.large, f"{what}: large")
        known = sorted({*MOTIONS[2], *MOTIONS[3]})
        free = (self.free,) if isinstance(self.free, str) else self.free
        if not isinstance(free, Sequence) or not set(free) <= set(known):
            raise InputError(f"{what}: free={shown(self.free)}; expected some of {known}")
        object.__setattr__(self, "free", tuple(dict.fromkeys(free)))  # it is frozen
        if not self.free and (self.force is not None or self.moment is not None):
            raise InputError(
                f"{what}: a force or a moment, and no free motion; expected free=, as free=('z',)"
            )
        if self.mass is not None:
            checked_number(self.mass, f"{what}: mass", POSITIVE)
        elif self.inertia is not None or self.velocity is not None:
            raise InputError(f"{what}: inertia or a velocity, and no mass; expected mass=")
        if self.mass is not None and not self.free:
            raise InputError(f"{what}: a mass, and no free motion; expected free=, as free=('z',)")
        if self.large and self.free:
            raise InputError(
                f"{what}: large=True with free motions; expected a body that moves by a law alone"
            )

    def check_dimension(self, gdim: int, whose: str) -> None:
        """Raise an InputError if shape, point or free motions are not those of this dimension."""
        if isinstance(self.shape, Placed):
            self.shape.check_dimension(gdim, whose)
        wrong = [name for name in self.free if name not in MOTIONS[gdim]]
        if wrong:
            raise InputError(f"{whose}: free={wrong}; expected some of {MOTIONS[gdim]} in {gdim}D")
        if self.point is not None and len(self.point) != gdim:
            raise InputError(f"{whose}: point={self.point}, expected {gdim} components")

    def masses(self, gdim: int) -> Array:
        """Return mass, and inertia, of each motion, shape ``(k,)``; 0 where there is none.

        Raise an InputError where inertia does not fit.
        """
        turns = (1,) if gdim == 2 else (3,)
        inertia = np.zeros(turns)
        if self.inertia is not None:
            expected = f"{turns[0]} positive number(s)"
            inertia = checked_vector(self.inertia, f"{self.name}: inertia", turns, expected)
        masses = np.append(np.full(gdim, self.mass or 0.0), inertia[::-1])
        if self.mass is not None and np.any(wrong := masses[own := self.indices(gdim)] <= 0.0):
            motion = MOTIONS[gdim][own[int(np.argmax(wrong))]]
            raise InputError(
                f"{self.name}: {motion} is free and has no moment of inertia; expected inertia=, "
                f"{turns[0]} positive number(s)"
            )
        return masses

    def start(self, gdim: int) -> Array:
        """Return the velocity at the start, shape ``(k,)``.

        Raise an InputError where it does not fit.
        """
        speed = np.zeros(len(MOTIONS[gdim]))
        if self.velocity is not None:
            expected, what = f"{gdim} finite numbers", f"{self.name}: velocity"
            speed[:gdim] = checked_vector(self.velocity, what, [gdim], expected)
        for motion, value in zip(MOTIONS[gdim], speed, strict=True):
            if value and motion not in self.free:
                raise InputError(
                    f"{self.name}: the velocity has a part along {motion}, which is not free "
                    f"(free={self.free})"
                )
        return speed

    def distance(self, x: Array) -> Array:
        """Signed distance from where it is, shape ``(n,)``."""
        return self.shape.distance(self._back(x))

    def gradient(self, x: Array) -> Array:
        """Gradient of the signed distance, shape ``(3, n)``."""
        gradient = self.shape.gradient(self._back(x))
        if self._pose is not None:
            gdim, gradient = len(self._pose.point), np.array(gradient, dtype=float)
            gradient[:gdim] = self._pose.rotation @ gradient[:gdim]
        return gradient

    def _back(self, x: Array) -> Array:
        """Points of the shape that are at x."""
        if self._pose is None:
            return x
        gdim, origin = len(self._pose.point), np.array(x)
        origin[:gdim] -= self._pose.way_to(x[:gdim].T).T
        return origin

    def placed(self, pose: Pose | None) -> RigidBody:
        """Return the same body at a place."""
        return replace(self, _pose=pose)

    def centre(self, gdim: int) -> Array:
        """Return the point that turns are about, shape ``(gdim,)``."""
        of_shape = getattr(self.shape, "centre", getattr(self.shape, "point", None))
        found = of_shape if self.point is None else self.point
        if found is None or callable(found):  # whatever a shape of one's own has
            return np.zeros(gdim)
        return np.asarray(found, dtype=float)[:gdim]

    def indices(self, gdim: int) -> Array:
        """Return the positions of the free motions among all."""
        return np.array([i for i, m in enumerate(MOTIONS[gdim]) if m in self.free], dtype=np.int64)

    def motion_and_load(self, gdim: int, time: float) -> tuple[Array, Array]:
        """Return the motion by the law, free ones 0, and force and moment, both of shape ``(k,)``.

        Raise an InputError where a value does not fit, a motion by the law is free, or a force acts
        on one that is not free.
        """
        found = []
        for names, free in ((("displacement", "rotation"), False), (("force", "moment"), True)):
            first, second = (self._value(name, gdim, time) for name in names)
            values = np.concatenate((first, second[::-1]))
            allowed = np.isin(np.arange(len(values)), self.indices(gdim)) == free
            if np.any(wrong := (values != 0.0) & ~allowed):
                motion = MOTIONS[gdim][int(np.argmax(wrong))]
                which, state = names[motion not in "xyz"], "not free" if free else "free"
                raise InputError(
                    f"{self.name}: the {which} has a part along {motion}, which is {state} (free="
                    f"{self.free}); expected displacements of guided motions and forces on free "
                    "ones"
                )
            found.append(values)
        return found[0], found[1]

    def _value(self, name: str, gdim: int, time: float) -> Array:
        """Return the value of a law at a time."""
        given: Any = getattr(self, name)
        turns = name in ("rotation", "moment")
        size = (1 if gdim == 2 else 3) if turns else gdim
        if given is None:
            return np.zeros(size)
        what = f"{self.name}: {name}"
        if isinstance(given, fem.Constant):
            given = given.value
        elif callable(given):
            with named(f"{what} at time {time:.6g}"):
                given = given(time)
        found = checked_vector(given, what, [size], f"{size} finite number(s)")
        # what turns a vector leaves rounding along axes that it is normal to
        return np.where(np.abs(found) > 4.0 * np.spacing(np.abs(found).max()), found, 0.0)


def has_facets(shape: Any) -> bool:
    """Return whether a shape, or that of a rigid body, is a ``SurfaceMesh``."""
    return isinstance(shape.shape if isinstance(shape, RigidBody) else shape, SurfaceMesh)
