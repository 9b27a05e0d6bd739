"""Where the two sides of a pair meet: mortar integrals of the secondary one's multipliers."""

from __future__ import annotations

from tfeti_dolfinx.contact.conditions import Shares, triplets
from tfeti_dolfinx.contact.sides import Side
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import facet_kind
from tfeti_dolfinx.mortar.integrals import integrate
from tfeti_dolfinx.mortar.pairing import possible_pairs, rendezvous
from tfeti_dolfinx.mortar.segments import find_segments

# One looks farther than the reach: else facets at its edge would be covered partly, and an overlap
# that is too deep would not be seen.
SEEN = 3.0


def meeting(
    name: str, sides: tuple[Side, Side], dofs: TornDofs, reach: float, depth: float
) -> Shares:
    """What facets of the first side that face the second contribute to its conditions. Collective.

    Args:
        name: Name of the contact, for messages.
        sides: The secondary side and the primary one.
        dofs: Dof maps.
        reach: How far apart facets may be; one looks three times as far.
        depth: How deep they may overlap; one looks three times as deep.

    Raises:
        InputError: The surfaces face away from each other.
    """
    kind, comm = facet_kind(dofs), dofs.comm
    distance = SEEN * max(reach, depth)
    secondary, primary = rendezvous(sides[0].facets, sides[1].facets, distance, comm)
    with raised_on_all_ranks(comm):
        pairs = possible_pairs(secondary, primary, distance)
        segments = find_segments(kind, secondary, primary, pairs, SEEN * depth, SEEN * reach)
        integrals = integrate(kind, secondary, primary, segments)
    averted = comm.allreduce(int(segments.averted))
    if averted and comm.allreduce(len(segments.weight)) == 0:
        raise InputError(
            f"{name}: the surfaces are near but face away from each other; expected "
            "outward normals that oppose each other"
        )
    vertices = secondary.groups[:, : kind.num_vertices]
    own, pair = integrals.facet, integrals.pair_secondary
    theirs = primary.groups[integrals.pair_primary]
    return Shares(
        vertices=vertices[own],
        covered=integrals.covered,
        gap=integrals.gap,
        curved_gap=integrals.curved_gap,
        entries=(
            triplets(vertices[own], secondary.groups[own], integrals.own),
            triplets(vertices[pair], theirs, -integrals.other),
        ),
    )
