"""Clusters of subdomains, glued by averages over their faces (hybrid TFETI): a plug-in."""

from __future__ import annotations

from functools import partial
from typing import Any

from tfeti_dolfinx.clusters.motions import motions_of_clusters
from tfeti_dolfinx.clusters.subdomains import ClusteredSubdomains, clusters_of
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs


def extension(wanted: int) -> dict[str, Any]:
    """Return the parts of ``Extensions`` that make about so many clusters."""

    def subdomains(dofs: TornDofs, decomposition: Decomposition) -> Any:
        return partial(ClusteredSubdomains, clusters_of(dofs, decomposition, wanted))

    return {"subdomains": subdomains, "deflation": motions_of_clusters}
