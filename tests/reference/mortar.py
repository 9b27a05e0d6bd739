"""Two boxes of rectangles by an untorn mesh, mortar integrals in closed form."""

from itertools import pairwise

import numpy as np

from reference.untorn import Conditions, two_boxes


def mortar_1d(secondary, primary, hats, low=0.0, high=1.0):
    """Integrals ∫ψ_i φ_k and ∫ψ_i φ_j of two meshes of the same interval, segment by segment.

    Over the secondary facets that begin between low and high; hats or dual multipliers.
    """
    D, M = (np.zeros((len(secondary), len(mesh))) for mesh in (secondary, primary))
    cuts = np.unique(np.concatenate((secondary, primary)).round(12))
    gauss, weight = np.polynomial.legendre.leggauss(3)
    for a, b in pairwise(cuts):
        for y, w in zip((a + b) / 2 + (b - a) / 2 * gauss, (b - a) / 2 * weight, strict=True):
            i = np.searchsorted(secondary, y) - 1
            j = np.searchsorted(primary, y) - 1
            t = (y - secondary[i]) / (secondary[i + 1] - secondary[i])
            s = (y - primary[j]) / (primary[j + 1] - primary[j])
            psi = np.array([1 - t, t] if hats else [2 - 3 * t, 3 * t - 1])
            if low <= secondary[i].round(12) < high:
                D[i : i + 2, i : i + 2] += w * np.outer(psi, (1 - t, t))
                M[i : i + 2, j : j + 2] += w * np.outer(psi, (1 - s, s))
    return D, M


def lever(cell, n_lower, n_upper, push, pull, secondary):
    """The lever of ``test_mortar``: points and displacements of its nodes, those of the secondary
    side, and their forces. Multipliers are hats up to the end of the facets that are held."""
    gdim = 2 if cell == "quadrilateral" else 3
    scene = two_boxes(
        cell,
        lambda x: (*(0.0,) * (gdim - 1), pull - (pull + push) * x[0]),
        ("lower bottom", "upper left"),
        n_lower,
        n_upper,
    )
    sides, n = ["upper bottom", "lower top"], [n_upper, n_lower]
    down = -1.0 if secondary == "upper" else 1.0
    if secondary == "lower":
        sides, n = sides[::-1], n[::-1]
    own, others = (scene.side(name)[0] for name in sides)
    meshes, end = [np.linspace(0, 1, k + 1) for k in n], round(1.0 / n_upper, 12)
    parts = [mortar_1d(*meshes, hats, *x) for hats, x in ((True, (0.0, end)), (False, (end, 1.0)))]
    if gdim == 3:  # nodes sorted by y, then x
        across = [mortar_1d(*meshes, hats) for hats in (True, False)]
        parts = [map(np.kron, *two) for two in zip(across, parts, strict=True)]
    D, M = map(sum, zip(*parts, strict=True))
    entries = [
        {int(node): W for node, W in zip((*own, *others), (*D[i], *-M[i]), strict=True)}
        for i in range(len(own))
    ]
    frame = np.vstack((down * np.eye(gdim)[-1], np.eye(gdim)[:-1]))
    met = Conditions(scene, entries, 0.0, np.zeros(gdim - 1), frame)
    u = met.solve()
    return scene.x[scene.order], u, scene.x[own], met.force[:, 0] * D.sum(axis=1)
