"""The rigid bodies of a problem: where they are, and how rows of contact know them."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root, box_over_ranks, maxima
from tfeti_dolfinx.contact.partner import GEOMETRY, ContactPartner, Obstacle
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.contact.rigid_body import MOTIONS, Pose, RigidBody, motion_fields
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.untorn import facet_points
from tfeti_dolfinx.mortar.facets import surface_facets
from tfeti_dolfinx.mortar.tolerances import SEARCH


@dataclass(frozen=True)
class RigidEntries:
    """Entries that unknowns of rigid bodies have in the v_i of conditions."""

    condition: Array  # condition of each entry, shape (k,)
    unknown: Array  # unknown among those of all rigid bodies, shape (k,)
    direction: Array  # what v_i changes by, shape (k, gdim)


@dataclass(frozen=True)
class ToolMotion:
    """Motion of a rigid body."""

    name: str  # its name
    motion: Array  # displacement and rotation vector of its point in the order of `MOTIONS`
    centre: Array  # where the point was when contact was searched, shape (gdim,)
    contacts: Array  # the contacts that it is in
    velocity: Array | None  # of free motions, in the same order; None without a mass


class Tools:
    """The rigid bodies that the contacts of a problem meet.

    They have one unknown for each free motion, a length: of a turn, its angle times the size of the
    surface. Translations are those of the middle of the surface, since about a point that is far
    off a turn is nearly a translation. All of them are on the last rank, behind the unknowns of its
    nodes. Creation raises an InputError where bodies do not fit the space, or two have the same
    name. Creation is collective.

    Attributes:
        bodies: The bodies, with their names.
        of_contact: Body of each contact, −1 without one.
        tool, mode: Body of each unknown, and its position in ``MOTIONS``.
        basis: Free motions by unknowns of size 1, shape ``(num_unknowns, num_unknowns)``.
        num_unknowns, num_local: Number of free motions of all bodies, and of those on this rank:
            all or none.
        unknowns: Of each body with free motions its unknowns.
        free_names: Names of the bodies with free motions.
        loads: Force and moment on the unknowns, shape ``(num_unknowns,)``.
        poses: Where each body was when contact was last searched.
        found: Motions of each body on top of that and of its law, of the last solve, shape
            ``(bodies, k)``; 0 but for free ones.
        begin: Where each body was when the load step began.
        mass: That of the unknowns, shape ``(num_unknowns, num_unknowns)``.
        law: Motion of each body by its law, shape ``(bodies, k)``.
        time_step: τ, 0 without inertia; the stiffness is 2M/τ², since the bodies' own is 0.
        velocity, start_velocity: Those of the unknowns when the time step began, and what a
            predictor has left of it, shape ``(num_unknowns,)``.
        predicted_increment: How far the unknowns come in the time step without any force.
        loads_at_begin: Force and moment when the step began.
    """

    def __init__(self, contacts: Sequence[ContactPartner], dofs: TornDofs) -> None:
        self._comm, decomposition = dofs.comm, dofs.decomposition
        self._gdim = gdim = decomposition.mesh.geometry.dim
        self.bodies: list[RigidBody] = []
        self.of_contact = np.full(len(contacts), -1)
        known: list[RigidBody] = []
        boxes = list[list[tuple[Array, Array]]]()  # of the surfaces of each body
        for i, contact in enumerate(contacts):
            if not isinstance(contact, Obstacle) or not isinstance(contact.shape, RigidBody):
                continue
            tool = contact.shape
            if dofs.bs != gdim or gdim == 1:
                raise InputError(f"{contact.name}: a RigidBody needs displacements in 2D or 3D")
            facets = surface_facets(decomposition, contact.surface)
            x = decomposition.mesh.geometry.x[facet_points(decomposition.mesh, facets).ravel()]
            box = box_over_ranks(self._comm, x)
            if tool not in known:
                known.append(tool)
                name = tool.name or f"tool of surface {contact.surface!r}"
                self.bodies.append(replace(tool, name=name))
                self.bodies[-1].check_dimension(gdim, name)
                boxes.append([])
            self.of_contact[i] = known.index(tool)
            boxes[known.index(tool)].append(box)
        names = [body.name for body in self.bodies]
        if len(set(names)) < len(names):
            raise InputError(f"rigid bodies have the names {names}; expected different ones")
        self._sizes = [max(float(np.linalg.norm(high - low)) for low, high in own) for own in boxes]
        free = [body.indices(gdim) for body in self.bodies]
        count, k = len(self.bodies), len(MOTIONS.get(gdim, ()))
        self.tool = np.repeat(np.arange(count), [len(own) for own in free])
        self.mode = np.concatenate([np.zeros(0, dtype=np.int64), *free])
        self.num_unknowns = len(self.tool)
        self.num_local = self.num_unknowns if self._comm.rank == self._comm.size - 1 else 0
        self.unknowns = {int(i): np.flatnonzero(self.tool == i) for i in np.unique(self.tool)}
        self.free_names = [names[i] for i in self.unknowns]
        self.basis = np.zeros((self.num_unknowns, self.num_unknowns))
        for i, own in self.unknowns.items():
            moves, turns = own[self.mode[own] < gdim], own[self.mode[own] >= gdim]
            middle = np.mean(boxes[i], axis=(0, 1))[:gdim] - self.bodies[i].centre(gdim)
            by_turns = motion_fields(middle[None])[0, self.mode[turns]] / self._sizes[i]
            self.basis[moves, moves], self.basis[turns, turns] = 1.0, 1.0 / self._sizes[i]
            self.basis[np.ix_(moves, turns)] = -by_turns[:, self.mode[moves]].T
        masses, velocities = np.zeros((2, count, k))
        for i, body in enumerate(self.bodies):
            masses[i], velocities[i] = body.masses(gdim), body.start(gdim)
        self.mass = self.basis.T @ (masses[self.tool, self.mode][:, None] * self.basis)
        self.velocity: Array = self._unknowns(velocities)
        self.time_step, self.start_velocity = 0.0, self.velocity
        self.predicted_increment = self.loads_at_begin = 0.0 * self.velocity
        self.law, self.found = np.zeros((2, count, k))
        self.loads: Array = np.zeros(self.num_unknowns)
        self.poses = [Pose(body.centre(gdim), np.zeros(k), body.large) for body in self.bodies]
        self.begin = list(self.poses)

    def __len__(self) -> int:
        return len(self.bodies)

    def laws(self, time: float) -> dict[str, tuple[Array, Array]]:
        """Return motion and load of each body at a time, by names for messages."""
        known = {body.name: body.motion_and_load(self._gdim, time) for body in self.bodies}
        return {f"{name}: motion and load": values for name, values in known.items()}

    def read(self, time: float) -> set[str]:
        """Take the values that laws have at a time; return what they change. Collective.

        That is ``right side`` where gaps change, ``places`` where a body has to be placed anew, and
        ``load`` where a force or moment changes. Raise an InputError where a value does not fit.
        """
        if not self.bodies:
            return set()
        with agreeing(self._comm, "laws of rigid bodies") as given:
            both = self.laws(time)
            given |= {"time": time, **both}
        law, loads = bcast_from_root(self._comm, np.array(list(both.values())).swapaxes(0, 1))
        loads = self.basis.T @ loads[self.tool, self.mode]
        moved = np.any(law != self.law, axis=1)
        placed = moved & np.array([body.large for body in self.bodies])
        changed = {"load"} if np.any(loads != self.loads) else set()
        self.law, self.loads = law, loads
        if np.any(moved):
            changed.add("places" if np.any(placed) else "right side")
        return changed

    def check_mass(self, has_mass: bool) -> None:
        """Raise an InputError where a body has a mass that none may have, or none that it needs."""
        for i in self.unknowns:
            if (self.bodies[i].mass is None) == has_mass:
                name, free = self.bodies[i].name, self.bodies[i].free
                raise InputError(
                    f"{name}: free={free} in a problem of bodies with mass; expected its mass="
                    if has_mass
                    else f"{name}: a mass in a problem without; expected none, or a ContactDynamics"
                )

    @property
    def stiffness(self) -> Array:
        """2M/τ² of the unknowns, 0 without inertia."""
        return self.mass * (2.0 / self.time_step**2 if self.time_step else 0.0)

    @property
    def load(self) -> Array:
        """Mean load on the unknowns and 2Mw/τ², w where they would be without any force."""
        if not self.time_step:
            return self.loads
        mean = 0.5 * (self.loads_at_begin + self.loads)
        return np.asarray(mean + self.stiffness @ (self.at_begin() + self.predicted_increment))

    def begin_time_step(self, time_step: float) -> None:
        """Begin a time step with the present velocity."""
        self.time_step, self.start_velocity = time_step, self.velocity
        self.predicted_increment = time_step * self.velocity

    @contextmanager
    def at_prediction(self) -> Iterator[None]:
        """Have the free motions where they are predicted, for a while."""
        known, at = self.found, self.at_begin() + self.predicted_increment
        self.found = self._motions(at)
        try:
            yield
        finally:
            self.found = known

    def of_mass_alone(self) -> Tools:
        """Return the same bodies with M for a stiffness, and Mw for a load."""
        other = copy.copy(self)
        other.loads = other.loads_at_begin = np.zeros(self.num_unknowns)
        other.time_step, other.found = np.sqrt(2.0), self.found.copy()
        return other

    def increment(self) -> Array:
        """Return how far the unknowns have come in the load step, shape ``(num_unknowns,)``."""
        return self._unknowns(self.found) - self.at_begin()

    def velocity_at_end(self) -> Array:
        """Return the velocity of the unknowns at the end of the time step."""
        if not self.time_step:
            return np.zeros(self.num_unknowns)
        apart = self.increment() - self.predicted_increment
        return np.asarray(self.start_velocity + 2.0 / self.time_step * apart)

    def _unknowns(self, motions: Array) -> Array:
        """Return the unknowns that have these motions, of shape ``(bodies, k)``."""
        return np.linalg.solve(self.basis, motions[self.tool, self.mode])

    def _motions(self, unknowns: Array) -> Array:
        """Return the motions that these unknowns are, of shape ``(bodies, k)``, 0 by laws."""
        motions = np.zeros(self.law.shape)
        motions[self.tool, self.mode] = self.basis @ unknowns
        return motions

    def place(self, finite: bool) -> None:
        """Place bodies where they are, in finite strain all, else those of large motions."""
        for i, body in enumerate(self.bodies):
            if not (finite or body.large):
                continue
            pose = replace(self.poses[i], finite=True)
            motion = self.pose(i).motion if finite else self.law[i]
            self.poses[i], self.found[i] = replace(pose, motion=motion), 0.0
            self.begin[i] = replace(self.begin[i], finite=True)

    def placed(self, contacts: Sequence[ContactPartner]) -> list[ContactPartner]:
        """Return the contacts with their bodies where they are."""
        found = list(contacts)
        for i in np.flatnonzero(self.of_contact >= 0):
            body, contact = int(self.of_contact[i]), found[i]
            assert isinstance(contact, Obstacle)
            found[i] = replace(contact, shape=self.bodies[body].placed(self.poses[body]))
        return found

    def steps(self) -> Array:
        """Return motions by laws since bodies were placed, shape ``(bodies, k)``."""
        steps = self.law - np.array([pose.motion for pose in self.poses]).reshape(self.law.shape)
        steps[self.tool, self.mode] = 0.0
        return np.asarray(steps)

    def pose(self, body: int) -> Pose:
        """Return where a body is after the last solve."""
        return self.poses[body].moved(self.steps()[body] + self.found[body])

    def begin_here(self) -> None:
        """Let a load step begin where the bodies are, as fast and with the loads that they have."""
        if self.time_step:
            self.velocity = self.velocity_at_end()
        self.loads_at_begin = np.array(self.loads)
        self.begin = [self.pose(i) for i in range(len(self))]

    def go_back(self, motions: Array | None = None) -> None:
        """Return to where the load step began, or to motions of shape ``(bodies * k,)``."""
        if motions is not None:
            known = motions.reshape(self.law.shape)
            both = zip(self.begin, known, strict=True)
            self.begin = [replace(pose, motion=motion) for pose, motion in both]
            law, self.law = self.law, known.copy()
            self.law[self.tool, self.mode] = law[self.tool, self.mode]
        self.found = self._motions(self.at_begin())

    def at_begin(self) -> Array:
        """Return the unknowns where the load step began, shape ``(num_unknowns,)``."""
        both = [[pose.motion for pose in poses] for poses in (self.begin, self.poses)]
        began, placed = np.array(both).reshape(2, *self.law.shape)
        return self._unknowns(began - placed)

    def motions(self) -> list[ToolMotion]:
        """Return where bodies are after the last solve."""
        velocity, found = self._motions(self.velocity_at_end()), list[ToolMotion]()
        for i, body in enumerate(self.bodies):
            contacts, pose = np.flatnonzero(self.of_contact == i), self.pose(i)
            at, v = self.poses[i].centre, None if body.mass is None else velocity[i]
            found.append(ToolMotion(body.name, pose.motion, at, contacts, v))
        return found

    def take(self, values: Array) -> None:
        """Take the unknowns of a solution, this rank's, shape ``(num_local,)``. Collective."""
        if self.num_unknowns:
            self.found = self._motions(self._comm.bcast(values, root=self._comm.size - 1))

    def motion(self, records: ContactRecords, found: bool = False) -> Array:
        """Return displacements of bodies at conditions, shape ``(n, gdim)``; 0 without a body.

        ``found``: free motions of the last solve count, too.
        """
        steps = self.steps() + (self.found if found else 0.0)
        motion = self.motion_there(records)
        for body, own in self._conditions(records):
            fields = motion_fields(records.place[own] - self.poses[body].centre)
            motion[own] += np.einsum("nkg,k->ng", fields, steps[body])
        return motion

    def motion_there(self, records: ContactRecords) -> Array:
        """Return what ``motion`` is where bodies were placed."""
        motion = np.zeros_like(records.place)
        for body, own in self._conditions(records):
            motion[own] = self.poses[body].way_to(records.place[own])
        return motion

    def motion_at_begin(self, records: ContactRecords) -> Array:
        """Return what ``motion`` was when the load step began, of the points that are there now."""
        motion = np.zeros_like(records.place)
        for body, own in self._conditions(records):
            x = records.place[own]
            motion[own] = self.begin[body].displacement(x - self.poses[body].way_to(x))
        return motion

    def entries(self, records: ContactRecords) -> RigidEntries:
        """Return entries of the unknowns in the v_i of conditions."""
        none = np.zeros(0, dtype=np.int64)
        rows, columns, values = [none], [none], [np.zeros((0, records.place.shape[1]))]
        at = dict(self._conditions(records))
        for body, unknowns in self.unknowns.items():
            own = at[body]
            fields = motion_fields(records.place[own] - self.poses[body].centre)
            for j in unknowns:
                rows.append(own)
                columns.append(np.full(len(own), j))
                along = self.basis[unknowns, j]
                values.append(-np.einsum("nkg,k->ng", fields[:, self.mode[unknowns]], along))
        return RigidEntries(np.concatenate(rows), np.concatenate(columns), np.concatenate(values))

    def check_begin(self, contacts: Sequence[ContactPartner], records: ContactRecords) -> None:
        """Raise if a rigid body begins inside of a surface. Collective."""
        overlap = np.zeros(max(len(contacts), 1))
        np.maximum.at(overlap, records.contact, -records.geometric_gap)
        overlap = maxima(self._comm, overlap)
        for i in np.flatnonzero(self.of_contact >= 0):
            body = int(self.of_contact[i])
            if np.any(self.poses[body].motion):  # it is elsewhere already
                continue
            if contacts[i].gap == GEOMETRY and overlap[i] > SEARCH.inside * self._sizes[body]:
                raise InputError(
                    f"{self.bodies[body].name} is inside of {contacts[i].surfaces[0]!r} at the "
                    f"start, {overlap[i]:.4g} deep; expected a rigid body outside, or touching, "
                    "that displacement= or force= presses in (in small strain gap= may give an "
                    "interference, as of a press fit)"
                )

    def check_nodes(self, contact: Array) -> None:
        """Raise if conditions with free motions have nothing but prescribed unknowns. Collective.

        Given are their contacts on this rank.
        """
        wrong = np.zeros(len(self.of_contact))
        wrong[contact] = 1.0
        if np.any(wrong := maxima(self._comm, wrong)):
            body = self.bodies[self.of_contact[int(np.argmax(wrong))]]
            raise InputError(
                f"{body.name}: a rigid body with free motions meets nodes whose displacement along "
                "the normal is prescribed; expected a surface without them, or a motion by a law"
            )

    def _conditions(self, records: ContactRecords) -> list[tuple[int, Array]]:
        """Return each body with the conditions of this rank that meet it."""
        if not self.bodies:
            return []
        of_condition = self.of_contact[records.contact]
        return [(i, np.flatnonzero(of_condition == i)) for i in range(len(self))]
