"""Saved states: an accepted solution in arrays that do not know how subdomains lie on ranks."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.common.validation import checked_type
from tfeti_dolfinx.constraints.gluing import Gluing
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.untorn import mix, set_key
from tfeti_dolfinx.qp.sets import Status
from tfeti_dolfinx.solution import Solution

# --- Labels: the same on any number of ranks --------------------------------------------------

SHIFT = 40  # no subdomain has 2^40 of anything

# an array by name, with the label of each of its rows; None: it is the same on all ranks
Table = dict[str, tuple[Array, Array | None]]


def numbered(subdomain: Array, *keys: Array) -> Array:
    """Return labels: what belongs to a subdomain is numbered in the order of its keys.

    They are the subdomain times 2^40, plus the number, shape ``(n,)``.
    """
    order = np.lexsort((*reversed(keys), subdomain))
    ascending = subdomain[order].astype(np.int64)
    labels = np.empty(len(order), dtype=np.int64)
    number = np.arange(len(order)) - np.searchsorted(ascending, ascending)
    labels[order] = (ascending << SHIFT) + number
    return labels


def labels_of_cells(decomposition: Decomposition) -> Array:
    """Return labels of this rank's cells, in the order of the original cells."""
    return numbered(decomposition.cell_subdomain, decomposition.original_cells)


def labels_of_dofs(dofmap: Array, count: int, decomposition: Decomposition) -> Array:
    """Return labels of what cells share: in the order of the first cell, and of places in it.

    ``dofmap`` has dofs, or points, of each cell, shape ``(cells, k)``; no two subdomains share one.
    """
    ids = decomposition.original_cells
    order = np.argsort(-ids)  # the first cell writes last
    subdomain, cell, place = np.empty((3, count), dtype=np.int64)
    subdomain[dofmap[order]] = decomposition.cell_subdomain[order][:, None]
    cell[dofmap[order]] = ids[order][:, None]
    place[dofmap[order]] = np.arange(dofmap.shape[1])
    return numbered(subdomain, cell, place)


def labels_of_nodes(dofs: TornDofs) -> Array:
    """Return labels of primal nodes."""
    cells = dofs.primal_node[np.asarray(dofs.V.dofmap.list)]
    return labels_of_dofs(cells, dofs.num_nodes, dofs.decomposition)


def labels_of_rows(gluing: Gluing, of_groups: Array) -> dict[str, Array]:
    """Return labels of ``rows`` and ``conditions``, from those of the nodes of owned groups.

    Rows of a node: equalities as they stand, of each contact that along the normal, and those along
    the tangents. Those of springs come last in a subdomain: stiffnesses say whether there are any.
    """
    dofs, sets, records = gluing.dofs, gluing.constraints.sets, gluing.records
    copies = dofs.multiplicity[:, None]
    count = np.sum(np.where(gluing.prescribed.flag, copies, copies - 1), axis=1)
    group, kind, place = np.zeros((3, gluing.constraints.num_rows), dtype=np.int64)
    group[sets.equalities] = np.repeat(of_groups, count)
    kind[sets.equalities] = -1
    place[sets.equalities] = np.arange(len(sets.equalities))
    normal, tangent = gluing.constraints.contact.normals, gluing.constraints.contact.points
    group[sets.normals] = of_groups[records.group[normal]]
    kind[sets.normals] = 2 * records.contact[normal]
    group[sets.tangents] = of_groups[records.group[tangent]][:, None]
    kind[sets.tangents] = 2 * records.contact[tangent][:, None] + 1
    place[sets.tangents] = np.arange(sets.tangents.shape[1])
    group[sets.springs] = (dofs.subdomains[sets.springs_of].astype(np.int64) + 1 << SHIFT) - 1
    place[sets.springs] = np.arange(len(sets.springs))
    rows = numbered(group >> SHIFT, group, kind, place)
    group = of_groups[records.group]
    return {"rows": rows, "conditions": numbered(group >> SHIFT, group, records.contact)}


def labels_of_groups(dofs: TornDofs, of_nodes: Array) -> Array:
    """Return for owned groups the labels of their first copies, which this rank has."""
    first = dofs.copies[dofs.copy_offsets[:-1]] - dofs.offsets[dofs.comm.rank]
    return np.asarray(of_nodes[first])


def same_labels(kept: Array, here: Array) -> bool:
    """Return whether labels are the same, in any order. Not collective."""
    return np.array_equal(np.sort(kept), np.sort(here))


def as_rows(values: Array, labels: Array) -> Array:
    """Return values, one after the other, as rows for labels; there may be none."""
    return values.reshape(len(labels), values.size // max(len(labels), 1))


def arranged(values: Array, kept: Array, here: Array) -> Array:
    """Return rows with labels in the order of other ones; what these have alone is 0."""
    out = np.zeros((len(here), *values.shape[1:]), dtype=values.dtype)
    _, to, of = np.intersect1d(here, kept, assume_unique=True, return_indices=True)
    out[to] = values[of]
    return out


# --- Saved state of a solution ----------------------------------------------------------------

# what the rows of an array are: labels of this name tell them apart
OF = {
    **dict.fromkeys(("u", "velocity", "load", "weights"), "nodes"),
    **dict.fromkeys(("lam", "status", "directions"), "rows"),
    **dict.fromkeys(("predicted", "image", "predicted_image"), "rows"),
    **dict.fromkeys(("slip", "contact", "group", "reached"), "conditions"),
    "internal": "cells",
    **dict.fromkeys(("layout", "springs"), "subdomains"),
}
KINDS = ("subdomains", "nodes", "cells", "rows", "conditions")


def absent(*shape: int, dtype: type = float) -> Any:
    """Return a field of an array that not all problems have."""
    return field(default_factory=lambda: np.zeros(shape, dtype))


@dataclass(frozen=True)
class SavedState:
    """An accepted solution on this rank, and what the next solve starts from."""

    subdomains: Array  # labels of this rank's subdomains
    layout: Array  # checksums of their cells and points in the mesh before it was torn
    springs: Array  # how many of their rows are of springs
    nodes: Array  # labels of primal nodes
    rows: Array  # labels of rows
    conditions: Array  # labels of conditions
    u: Array  # displacement in primal order
    lam: Array  # multipliers λ of this rank's rows
    mu: Array  # multipliers of Gλ = e; empty where they are not known
    norm: Array  # estimate of ‖F‖ that solves have come to, shape ()
    law_target: Array  # what solves with Coulomb's law leave of residuals, as `Dual` has it, (2,)
    status: Array  # status of each row, see `qp.sets.Status`
    slip: Array  # where the load step began: tangential v_i of the conditions, (n, gdim - 1)
    reach: Array  # how far was searched in each contact
    secondary: Array  # tag of the surface of each contact that has its conditions
    contact: Array  # contact of each condition
    group: Array  # label of the node of each condition
    reached: Array  # whether a condition is within reach
    cells: Array = absent(0, dtype=np.int64)  # labels of cells, where there are internal variables
    velocity: Array = absent(0)  # velocity in primal order, empty without inertia
    load: Array = absent(0)  # load likewise
    predicted: Array = absent(0)  # multipliers of this rank's rows of the predictor
    size: Array = absent()  # of the step which the matrix was made for, shape (); 0 without inertia
    directions: Array = absent(0, 2, 0)  # what `Recycled` keeps of earlier solves, shape (m, 2, k)
    internal: Array = absent(0, 0)  # internal variables in each cell, (cells, w)
    tools: Array = absent(0)  # motions of rigid bodies, one after the other
    tool_speed: Array = absent(0)  # velocities of their unknowns, with mass
    tool_loads: Array = absent(0)  # their loads at the begin of the next step, with mass
    image: Array = absent(0)  # Fλ; empty where it is not known
    predicted_image: Array = absent(0)  # the same of the predictor
    weights: Array = absent(0)  # D of a nonlinear problem, which rows are scaled with, as u
    # whether Newton's method keeps places yet, shape (), see `ModelKeeping`
    freezes: Array = field(default_factory=lambda: np.ones(()))

    @classmethod
    def of(cls, solution: Solution, mu: Array, dual: Dual, reach: list[float]) -> SavedState:
        """Return the state of a solution."""
        gluing, holding = solution.gluing, solution.holding
        records, dofs = gluing.records, solution.dofs
        tag_of = solution.decomposition.surface
        bearing = np.where(holding, Status.STICK, Status.SLIP)
        nodes = labels_of_nodes(dofs)
        of_groups = labels_of_groups(dofs, nodes)
        return cls(
            subdomains=solution.decomposition.subdomains.astype(np.int64) << SHIFT,
            layout=layout_of(solution.decomposition),
            springs=springs_of(gluing),
            nodes=nodes,
            **labels_of_rows(gluing, of_groups),
            u=solution.u,
            lam=solution.lam,
            mu=mu,
            norm=np.array(dual.norm),
            law_target=np.array(dual.law_target),
            status=np.where(solution.carrying, bearing, Status.OPEN),
            slip=gluing.slip,
            reach=np.array(reach, dtype=float),
            secondary=np.array([tag_of(c.surfaces[0]) for c in solution.contacts], dtype=np.int64),
            contact=records.contact,
            group=of_groups[records.group],
            reached=records.within_reach,
        )

    @classmethod
    def from_table(cls, table: Table) -> SavedState:
        """Return what ``table`` has made a table of, of these or other subdomains."""
        values = {name: array for name, (array, _) in table.items()}
        for name in ("u", "velocity", "load", "weights"):
            values[name] = values[name].reshape(-1)
        for name, kind in OF.items():
            _, labels = table[name]
            if labels is not None:
                values[kind] = labels
        return cls(**values)

    def table(self) -> Table:
        """Return the arrays with the labels of their rows; those that are empty have none."""
        found: Table = {}
        for f in fields(self):
            values = getattr(self, f.name)
            if f.name in KINDS:
                continue
            if OF.get(f.name) == "nodes" and values.size:
                values = as_rows(values, self.nodes)
            labels = getattr(self, OF[f.name]) if f.name in OF else None
            known = labels is not None and len(labels) == len(values)
            found[f.name] = (values, labels if known else None)
        return found

    def on_nodes(self, dofs: TornDofs) -> SavedState:
        """Return the state with nodes and cells in the order of this rank. Not collective."""
        here = {"nodes": labels_of_nodes(dofs)}
        if self.internal.size:
            here["cells"] = labels_of_cells(dofs.decomposition)
        return self._in_order(here)

    def on_rows(self, gluing: Gluing) -> SavedState:
        """Return the state with rows and conditions in the order of a problem's. Collective."""
        of_groups = labels_of_groups(gluing.dofs, self.nodes)
        here, records = labels_of_rows(gluing, of_groups), gluing.records
        springs, comm = springs_of(gluing), gluing.dofs.comm
        others = any_rank(comm, not np.array_equal(springs, self.springs))
        with raised_on_all_ranks(comm):
            kept, rows = self._held(self.rows, self.springs), self._held(here["rows"], springs)
            same = same_labels(kept, rows) and same_labels(self.conditions, here["conditions"])
            state = self._in_order(here) if same else self
            if others:  # of another stiffness: what of F and its kernel is known, too
                state = state.without_products()
            found = (state.contact, state.group, state.reached)
            expected = (records.contact, of_groups[records.group], records.within_reach)
            if not same or not all(map(np.array_equal, found, expected)):
                raise InputError(
                    "the state has other contact constraints than the problem: expected the "
                    "contacts, conditions and data that it was found with"
                )
        return state

    def without_products(self) -> SavedState:
        """Return the state without what is of one F and its kernel alone."""
        none, directions = np.zeros(0), np.zeros((0, 2, 0))
        return replace(self, mu=none, image=none, predicted_image=none, directions=directions)

    def _held(self, rows: Array, springs: Array) -> Array:
        """Return labels of rows but for those of springs, of which subdomains have so many."""
        subdomain = np.searchsorted(self.subdomains, rows, side="right") - 1
        count = np.bincount(subdomain, minlength=len(springs)) - springs
        return rows[rows - self.subdomains[subdomain] < count[subdomain]]

    def _in_order(self, here: dict[str, Array]) -> SavedState:
        """Return the state with rows of these kinds in the order of these labels."""
        changed = dict(here)
        for name, (values, labels) in self.table().items():
            if labels is None or OF[name] not in here:
                continue
            values = arranged(values, labels, here[OF[name]])
            changed[name] = values.reshape(-1) if OF[name] == "nodes" else values
        return replace(self, **changed)

    def groups(self, dofs: TornDofs) -> list[Array]:
        """Return the owned groups whose nodes have rows, of each contact."""
        of_groups = labels_of_groups(dofs, self.nodes)
        order = np.argsort(of_groups)
        own = order[np.searchsorted(of_groups, self.group, sorter=order)]
        return [own[self.reached & (self.contact == i)] for i in range(len(self.reach))]

    def common(self) -> dict[str, Any]:
        """Return what all ranks' states must share, since searches and solves depend on it."""
        return {
            "reach": self.reach.tolist(),
            "secondary": self.secondary.tolist(),
            "size": float(self.size),
            "norm": float(self.norm),
            "law_target": self.law_target.tolist(),
            "freezes": bool(self.freezes),
            "mu": [len(self.mu), float(self.mu.sum()), float(np.abs(self.mu).sum())],
            "number of directions": self.directions.shape[2],
        }


def springs_of(gluing: Gluing) -> Array:
    """Return how many rows of springs each subdomain of this rank has."""
    count = len(gluing.dofs.decomposition.subdomains)
    return np.bincount(gluing.constraints.sets.springs_of, minlength=count)


def layout_of(decomposition: Decomposition) -> Array:
    """Return a checksum of each subdomain's cells and their points before the mesh was torn."""
    points = decomposition.original_nodes[geometry_dofmap(decomposition.mesh)]
    keys = mix(decomposition.original_cells) + set_key(points)
    sums = np.zeros(len(decomposition.subdomains), dtype=np.uint64)
    place = np.searchsorted(decomposition.subdomains, decomposition.cell_subdomain)
    np.add.at(sums, place, mix(keys))
    return sums


def check_state(state: SavedState, dofs: TornDofs, contacts: int) -> None:
    """Raise unless a state is of this mesh, on these ranks, of this space, of so many contacts.

    Not collective: a rank may have another one.
    """
    checked_type(state, SavedState, "state", "what ContactProblem.state returned")
    if not np.array_equal(state.layout, layout_of(dofs.decomposition)):
        raise InputError(
            "the state is of another mesh, or of one that was distributed in another way; "
            "expected the same mesh in the same subdomains"
        )
    size = dofs.num_nodes * dofs.bs
    if not same_labels(state.nodes, labels_of_nodes(dofs)) or len(state.u) != size:
        raise InputError(
            f"the state has {len(state.u)} displacements on this rank; expected those of the "
            f"problem's space, {size}"
        )
    if len(state.reach) != contacts:
        raise InputError(
            f"the state is of {len(state.reach)} contacts; expected those of the problem, "
            f"{contacts}"
        )
