"""Two boxes of rectangles by an untorn mesh, mortar integrals in closed form."""

from itertools import pairwise

import numpy as np

from reference.untorn import Conditions, two_boxes


def mortar_1d(secondary, primary):
    """Integrals ∫φ_i and ∫ψ_i φ_j of two meshes of the same interval, segment by segment."""
    D, M = np.zeros(len(secondary)), np.zeros((len(secondary), len(primary)))
    cuts = np.unique(np.concatenate((secondary, primary)).round(12))
    gauss, weight = np.polynomial.legendre.leggauss(3)
    for a, b in pairwise(cuts):
        for y, w in zip((a + b) / 2 + (b - a) / 2 * gauss, (b - a) / 2 * weight, strict=True):
            i = np.searchsorted(secondary, y) - 1
            j = np.searchsorted(primary, y) - 1
            t = (y - secondary[i]) / (secondary[i + 1] - secondary[i])
            s = (y - primary[j]) / (primary[j + 1] - primary[j])
            for k, psi, phi in ((i, 2 - 3 * t, 1 - t), (i + 1, 3 * t - 1, t)):
                D[k] += w * phi
                M[k, j] += w * psi * (1 - s)
                M[k, j + 1] += w * psi * s
    return D, M


def lever(cell, n_lower, n_upper, push, pull, secondary):
    """The lever of ``test_mortar``: points and displacements of its nodes, those of the secondary
    side, and their forces."""
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
    D, M = mortar_1d(*(np.linspace(0, 1, k + 1) for k in n))
    if gdim == 3:  # nodes sorted by y, then x
        D, M = np.kron(D, D), np.kron(M, M)
    entries = [
        {int(node): D[i], **{int(other): -M[i, j] for j, other in enumerate(others)}}
        for i, node in enumerate(own)
    ]
    frame = np.vstack((down * np.eye(gdim)[-1], np.eye(gdim)[:-1]))
    met = Conditions(scene, entries, 0.0, np.zeros(gdim - 1), frame)
    u = met.solve()
    return scene.x[scene.order], u, scene.x[own], met.force[:, 0] * D
