"""A solution as plain arrays, from which another run of the same program goes on."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.checks import checked_type
from tfeti_dolfinx.contact_state import Multipliers
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.gluing.glue import Gluing
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.parallel import any_rank
from tfeti_dolfinx.qp.faces import Status, face_of
from tfeti_dolfinx.solution import Solution


@dataclass(frozen=True)
class SavedState:
    """An accepted solution on this rank, and what the next solve starts from.

    Attributes:
        layout: Checksums of this rank's part of the mesh and its unknowns, shape ``(4,)``.
        u: Displacement in primal order.
        lam: Multipliers λ of this rank's rows.
        mu: Multipliers of Gλ = e.
        norm: Estimate of ‖F‖ that solves have come to, shape ``()``.
        status: Status of each row, see ``qp.faces``.
        slip: Where the load step began: tangential v_i of the conditions, ``(n, gdim - 1)``.
        reach: How far was searched in each contact.
        contact: Contact of each condition with a row.
        group: Owned group of each condition with a row.
        velocity: Velocity in DOLFINx's order, empty without inertia.
        load: Load likewise.
        predicted: Multipliers of this rank's rows of the predictor, empty without one.
        size: That of the step which the matrix was made for, shape ``()``; 0 without inertia.
        directions: What ``Recycled`` keeps of earlier solves, shape ``(2, m, k)``.
        image: Fλ; empty where it is not known.
        predicted_image: The same of the predictor.
    """

    layout: Array
    u: Array
    lam: Array
    mu: Array
    norm: Array
    status: Array
    slip: Array
    reach: Array
    contact: Array
    group: Array
    velocity: Array = field(default_factory=lambda: np.zeros(0))
    load: Array = field(default_factory=lambda: np.zeros(0))
    predicted: Array = field(default_factory=lambda: np.zeros(0))
    size: Array = field(default_factory=lambda: np.zeros(()))
    directions: Array = field(default_factory=lambda: np.zeros((2, 0, 0)))
    image: Array = field(default_factory=lambda: np.zeros(0))
    predicted_image: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, solution: Solution, mu: Array, norm: float, reach: list[float]) -> SavedState:
        """The state of a solution."""
        records, holding = solution.gluing.records, solution.holding
        held = np.where(holding, Status.STICK, Status.SLIP)
        return cls(
            layout=layout_of(solution.dofs, solution.decomposition),
            u=solution.u,
            lam=solution.lam,
            mu=mu,
            norm=np.array(norm),
            status=np.where(solution.carrying, held, Status.OPEN),
            slip=solution.gluing.slip,
            reach=np.array(reach, dtype=float),
            contact=records.contact[records.within_reach],
            group=records.group[records.within_reach],
        )

    def groups(self) -> list[Array]:
        """The groups whose nodes have rows, of each contact."""
        return [self.group[self.contact == i] for i in range(len(self.reach))]

    def multipliers(self) -> Multipliers:
        """The multipliers, with a face that only knows what rows do."""
        return Multipliers(self.lam, face_of(np.zeros(len(self.lam), dtype=bool), self.status))

    def common(self) -> dict[str, Any]:
        """What the states of all ranks must have alike, since searches and solves go by it."""
        size = float(np.abs(self.mu).sum())
        return {
            "reach": self.reach.tolist(),
            "size": float(self.size),
            "norm": float(self.norm),
            "mu": [len(self.mu), float(self.mu.sum()), size],
            "number of directions": self.directions.shape[2],
        }

    def check_rows(self, gluing: Gluing) -> None:
        """Raise unless rows are those of the state. Collective.

        Raises:
            InputError: They are others.
        """
        records = gluing.records
        sizes = (len(self.lam), len(self.slip), self.contact.tolist(), self.group.tolist())
        kept, wide = records.within_reach, self.directions.shape
        found = (records.contact[kept].tolist(), records.group[kept].tolist())
        comm, parts = gluing.dofs.comm, ("image", "predicted", "predicted_image")
        known = [name for name in parts if any_rank(comm, getattr(self, name).size > 0)]
        with raised_on_all_ranks(comm):
            rows = gluing.constraints.num_rows
            if sizes != (rows, len(records), *found) or (wide[2] and wide[:2] != (2, rows)):
                raise InputError(
                    "the state has other contact rows than the problem: expected the contacts, "
                    "conditions and data that it was found with"
                )
            for name in known:
                _check_broken(name, getattr(self, name).shape == (rows,))


def layout_of(dofs: TornDofs, decomposition: Decomposition) -> Array:
    """Checksums of this rank's part of the mesh and its unknowns."""
    numbers = (
        decomposition.cell_subdomain,
        decomposition.original_cells,
        dofs.dolfinx_node,
        dofs.group * dofs.bs,
    )
    return np.array([zlib.crc32(np.asarray(n, dtype=np.int64).tobytes()) for n in numbers])


def check_state(
    state: SavedState, dofs: TornDofs, decomposition: Decomposition, contacts: int
) -> None:
    """Raise unless a state is whole, of this mesh, on these ranks, with so many contacts.

    Not collective: a rank may have a broken one.

    Raises:
        InputError: It is not.
    """
    checked_type(state, SavedState, "state", "what ContactProblem.state returned")
    for f in fields(state):
        checked_type(getattr(state, f.name), np.ndarray, f"state: {f.name}", "an array")
    if not np.array_equal(state.layout, layout_of(dofs, decomposition)):
        raise InputError(
            "the state is of another mesh, or of one that was distributed in another way; "
            "expected the same mesh on as many ranks"
        )
    if len(state.reach) != contacts:
        raise InputError(
            f"the state is of {len(state.reach)} contacts; expected those of the problem, "
            f"{contacts}"
        )
    rows, conditions = state.lam.shape, state.contact.shape
    unknowns = (len(dofs.dolfinx_node) * dofs.bs,)
    shapes = {"u": unknowns, "norm": (), "status": rows, "group": conditions, "size": ()}
    axes = {"lam": 1, "mu": 1, "slip": 2, "reach": 1, "contact": 1, "directions": 3}
    for name, shape in shapes.items():
        _check_broken(name, getattr(state, name).shape == shape)
    for name, count in axes.items():
        _check_broken(name, getattr(state, name).ndim == count)
    for name in ("image", "predicted", "predicted_image"):
        _check_broken(name, getattr(state, name).shape in ((0,), rows))
    for name in ("u", "lam", "mu", "norm", "slip", "velocity", "load", "predicted", "directions"):
        _check_broken(name, bool(np.all(np.isfinite(getattr(state, name)))))
    for name, size in (("contact", contacts), ("group", dofs.num_groups)):
        values = getattr(state, name)
        _check_broken(name, bool(np.all((values >= 0) & (values < size))))


def _check_broken(name: str, right: bool) -> None:
    """Raise an InputError unless an array of a state is right."""
    if not right:
        raise InputError(
            f"the state is broken: {name} has another shape than in any solution of the problem, "
            "or no numbers; expected what ContactProblem.state returned"
        )
