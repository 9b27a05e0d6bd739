"""The Block of a subdomain with boundary elements."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from tfeti_dolfinx.bem.inside import Inside, SolvedBody
from tfeti_dolfinx.bem.panels import Surface, surfaces
from tfeti_dolfinx.bem.steklov import TOLERANCES as QUADRATURE
from tfeti_dolfinx.bem.steklov import SurfaceStiffness
from tfeti_dolfinx.common.arrays import Array, node_blocks
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.block import Block, SubdomainData
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.sparse_block import EQUAL, SparseBlock, Stiffness, places_in_order
from tfeti_dolfinx.subdomains.subdomains import MakeBlock, subdomain_stiffness

# --- Block of a subdomain with boundary elements ----------------------------------------------


@dataclass(frozen=True)
class Part:
    """A subdomain with boundary elements.

    Attributes:
        name: Name for messages.
        shape: Its shape, maybe that of others, too.
        place: Unknown of the shape for each of its own, shape ``(n,)``.
    """

    name: str
    shape: SurfaceStiffness
    place: Array

    @property
    def on_surface(self) -> Array:
        """Flags of its unknowns on the surface, shape ``(n,)``."""
        return self.place < self.shape.outer * self.shape.x.shape[1]

    def body_force_load(self, hats: Array, b: Array) -> Array:
        """Load on its unknowns of a force b per volume, shape ``(n,)``.

        Args:
            hats: Integrals of the hats over the volume, shape ``(n / d,)``.
            b: Shape ``(d,)``.
        """
        d = len(b)
        placed = np.empty_like(hats)
        placed[self.place[::d] // d] = hats
        return self.shape.body_force_load(placed, b)[self.place]


class BoundaryBlock(SparseBlock):
    """Block of K_S; its Schur complement on the surface is S.

    Args:
        data: The subdomain, of which the stiffness is not looked at.
        part: What takes its place.
        factory: Makes inverses.

    Raises:
        InputError: The load is not finite, or a row touches nodes inside.
        FactorError: A factor could not be made.
    """

    def __init__(self, data: SubdomainData, part: Part, factory: InverseFactory) -> None:
        self._part = part
        if not part.on_surface[data.trace_dofs].all():
            raise InputError(
                f"{part.name}: a value is prescribed inside boundary elements; expected it on "
                "their surface"
            )
        super().__init__(data, factory)

    def _found(self, K: Any) -> tuple[Stiffness, Array]:
        """Return the stiffness of the part's shape, and the place of its unknowns there."""
        return self._part.shape.stiffness, self._part.place


# --- Boundary elements of all subdomains of a rank --------------------------------------------


class Parts:
    """The subdomains of a rank with boundary elements. Creation and methods are collective.

    Args:
        dofs: Dof maps of displacements of degree 1.
        decomposition: The torn mesh.
        chosen: Flags of the subdomains of this rank, shape ``(S,)``.
        factory: Makes inverses.

    Attributes:
        parts: By their positions in ``dofs.subdomains``.

    Raises:
        InputError: The mesh or the space does not fit.
    """

    def __init__(
        self, dofs: TornDofs, decomposition: Decomposition, chosen: Array, factory: InverseFactory
    ) -> None:
        self._dofs, self._decomposition, self._factory = dofs, decomposition, factory
        self._surfaces = surfaces(dofs, decomposition, chosen)
        names, body = decomposition.body_names, decomposition.body_of_subdomain
        self._names = {
            s: f"{names[body[subdomain]]}, subdomain {subdomain}"
            for s, subdomain in enumerate(dofs.subdomains.tolist())
        }
        self.parts: dict[int, Part] = {}
        self._forces: dict[int, Array] = {}

    def take_stiffness(self, K: Any, blocks: Array) -> Array:
        """Make S from the stiffness of finite elements.

        Args:
            K: This rank's, in DOLFINx's numbering, scipy CSR.
            blocks: Its block of each primal node, shape ``(num_nodes, bs, bs)``.

        Returns:
            The blocks with those of K_S in their place.

        Raises:
            InputError: K is not that of homogeneous, isotropic bodies.
            FactorError: S could not be made.
        """
        dofs, blocks, bs = self._dofs, blocks.copy(), self._dofs.bs
        rows = dofs.dolfinx_dofs()
        primal = np.empty(len(rows), dtype=np.int32)
        primal[rows] = np.arange(len(rows))
        shapes: dict[bytes, list[SurfaceStiffness]] = defaultdict(list)
        with raised_on_all_ranks(dofs.comm):
            self.parts = {}
            for s, surface in self._surfaces.items():
                own = self._unknowns(s)
                K_s = subdomain_stiffness(K, rows[own], primal, own.start)
                part = self.parts[s] = _part(self._names[s], surface, K_s, shapes, self._factory)
                own_blocks = node_blocks(part.shape.K, bs)[part.place[::bs] // bs]
                blocks[own.start // bs : own.stop // bs] = own_blocks
        return blocks

    def load(self, f: Array, volume: Array | None, hats: Array | None) -> Array:
        """Return the load with that of boundary elements in the place of that of finite ones.

        Args:
            f: The load in primal order.
            volume: Its part from integrals over cells, or None if there are none.
            hats: With it, integrals of the hats over the cells, one for each primal node.

        Raises:
            InputError: It is something else than tractions and constant forces per volume.
        """
        f = f.copy()
        with raised_on_all_ranks(self._dofs.comm):
            for s, part in self.parts.items():
                own, d = self._unknowns(s), self._dofs.bs
                surface, f[own] = f[own].copy(), 0.0
                self._forces[s] = np.zeros(d)
                size = np.abs(surface).max(initial=0.0)
                if volume is not None and hats is not None:
                    surface -= volume[own]
                    hats_s = hats[own.start // d : own.stop // d]
                    b = self._forces[s] = _force_per_volume(part.name, volume[own], hats_s)
                    f[own] = part.body_force_load(hats_s, b)
                _check_inside(part, surface, size)
                f[own] += np.where(part.on_surface, surface, 0.0)
        return f

    def blocks(self, make_block: MakeBlock) -> MakeBlock:
        """Return the factory of this rank's Blocks, those of finite elements as given."""
        by_name = {f"subdomain {self._dofs.subdomains[s]}": p for s, p in self.parts.items()}

        def make(data: SubdomainData) -> Block:
            part = by_name.get(data.name)
            return make_block(data) if part is None else BoundaryBlock(data, part, self._factory)

        return make

    def solved(self, u: Array) -> Callable[[], Iterator[SolvedBody]]:
        """The solution inside each of the parts, one at a time, with the present load.

        Args:
            u: Displacement in primal order.
        """
        forces = dict(self._forces)

        def bodies() -> Iterator[SolvedBody]:
            for s, part in self.parts.items():
                moved = np.empty(len(part.place))
                moved[part.place] = u[self._unknowns(s)]
                shape, corner = part.shape, self._surfaces[s].panels.x.min(axis=0)
                on_surface = moved.reshape(shape.x.shape)[: shape.outer]
                shift = corner - shape.x.min(axis=0)
                inside = Inside(shape.bodies[0], on_surface, forces[s], shift)
                hidden = np.flatnonzero(~part.on_surface[:: self._dofs.bs])
                nodes = int(self._dofs.node_offsets[s]) + hidden
                yield SolvedBody(int(self._dofs.subdomains[s]), inside, nodes)

        return bodies

    def inside(self) -> int:
        """Return the number of unknowns of all ranks that boundary elements do without."""
        count = sum(int(np.sum(~part.on_surface)) for part in self.parts.values())
        return int(self._dofs.comm.allreduce(count))

    def _unknowns(self, s: int) -> slice:
        offsets, bs = self._dofs.node_offsets, self._dofs.bs
        return slice(int(offsets[s]) * bs, int(offsets[s + 1]) * bs)


def _part(
    name: str,
    surface: Surface,
    K: Any,
    shapes: dict[bytes, list[SurfaceStiffness]],
    factory: InverseFactory,
) -> Part:
    """Return a subdomain, of a shape that is known or a new one."""
    key, order = places_in_order(surface.panels.x)
    outside = np.zeros(len(order), dtype=bool)
    outside[surface.panels.nodes] = True
    order = order[np.argsort(~outside[order], kind="stable")]  # those on the surface first
    d = surface.panels.dim
    unknowns = (order[:, None] * d + np.arange(d)).ravel()
    moved, placed = K[unknowns][:, unknowns], surface.placed(order)
    moved.sort_indices()
    place = np.empty_like(unknowns)
    place[unknowns] = np.arange(len(unknowns))
    for shape in shapes[key]:
        if _equal(shape, placed, moved):
            return Part(name, shape, place)
    shapes[key].append(SurfaceStiffness(name, placed, moved, factory))
    return Part(name, shapes[key][-1], place)


def _equal(shape: SurfaceStiffness, surface: Surface, K: Any) -> bool:
    """Return whether parts are equal, in size too, which K does not show in 2D."""
    pairs = zip(shape.surface.cuts, surface.cuts, strict=True)
    if not all(np.array_equal(one.nodes, other.nodes) for one, other in pairs):
        return False
    ours, theirs = (x - x.min(axis=0) for x in (surface.panels.x, shape.x))
    if np.abs(ours - theirs).max() > EQUAL.place * theirs.max():
        return False
    return bool(abs(K - shape.K_fem).max() <= EQUAL.entry * np.abs(K.data).max())


def _force_per_volume(name: str, volume: Array, hats: Array) -> Array:
    """Return the constant b whose load this is."""
    forces = volume.reshape(len(hats), -1)
    b = forces.sum(axis=0) / hats.sum()
    if np.abs(forces - hats[:, None] * b).max() > QUADRATURE.constant * np.abs(forces).max(
        initial=0.0
    ):
        raise InputError(
            f"{name}: a load per volume varies there; boundary elements take a constant "
            "force per volume and tractions. Expected one of them, or finite elements"
        )
    return np.asarray(b)


def _check_inside(part: Part, f: Array, size: float) -> None:
    """Raise if something else than an integral over cells acts inside."""
    if np.abs(f[~part.on_surface]).max(initial=0.0) > QUADRATURE.constant * size:
        raise InputError(
            f"{part.name}: a load acts on facets inside boundary elements; expected tractions on "
            "their surface"
        )
