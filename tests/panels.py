"""Closed surfaces of panels, and Kelvin's solution on them."""

import numpy as np

from tfeti_dolfinx.bem.panels import Panels


def polygon(corners, m, grading=1.0):
    """Its sides, counter-clockwise, in m segments each."""
    corners = np.asarray(corners, dtype=float)
    s = np.linspace(0.0, 1.0, m + 1)[:-1] ** grading
    x = np.concatenate(
        [
            a + s[:, None] * (b - a)
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        ]
    )
    first = np.arange(len(x))
    return Panels(x, np.stack((first, np.roll(first, -1)), axis=1))


def joined(outer, inner):
    """A body with a hole, the inner surface turned around."""
    nodes = np.concatenate((outer.nodes, len(outer.x) + inner.nodes[:, ::-1]))
    return Panels(np.concatenate((outer.x, inner.x)), nodes)


def circle(m, radius=1.0):
    angle = 2 * np.pi * np.arange(m) / m
    return polygon(radius * np.stack((np.cos(angle), np.sin(angle)), axis=1), 1)


SQUARE = [(0, 0), (0.5, 0), (0.5, 0.5), (0, 0.5)]
HOOK = [(0, 0), (2, 0), (2, 0.7), (0.6, 0.7), (0.6, 3), (0, 3)]
PLANE = {
    "square": lambda m=8: polygon(SQUARE, m),
    "hook": lambda m=8: polygon(HOOK, m),
    "ring": lambda m=8: joined(circle(4 * m), circle(4 * m, 0.6)),
    "graded": lambda m=8: polygon([(0, 0), (3, 0), (2, 1), (0.2, 1.5)], m, 1.3),
}


def box(m, sizes=(1.0, 1.0, 1.0)):
    """A box of m × m quadrilaterals on each side, each of them two triangles."""
    places, triangles = {}, []
    for axis in range(3):
        for side in (0, m):
            corner = np.eye(3, dtype=int)[axis] * side
            u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
            for i, j in np.ndindex(m, m):
                steps = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
                points = [tuple((corner + a * u + b * v).tolist()) for a, b in steps]
                q = [places.setdefault(point, len(places)) for point in points]
                pair = [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]
                triangles += pair if side else [t[::-1] for t in pair]
    return Panels(np.array(list(places)) / m * sizes, np.array(triangles))


def moved(panels, move):
    return Panels(move(panels.x), panels.nodes)


def _blown(x):
    """A cube around 0 becomes a ball."""
    y = 2 * x - 1
    return y * (np.abs(y).max(axis=1) / np.linalg.norm(y, axis=1))[:, None]


SPACE = {
    "cube": lambda m=2: box(m),
    "bar": lambda m=2: box(m, (3.0, 1.0, 1.0)),
    "ball": lambda m=2: moved(box(m), _blown),
    "wedge": lambda m=2: moved(
        box(m), lambda x: np.stack((x[:, 0], x[:, 1], x[:, 2] * (1 + x[:, 0])), axis=1)
    ),
}


def kelvin(x, source, law):
    """Displacement of a force e_1 at a point, shape ``(n, d)``, and its gradients ∂_j u_i."""
    r = x - source
    d = x.shape[1]
    size = np.linalg.norm(r, axis=1)[:, None]
    factor = law.single / (4 * np.pi if d == 3 else 2 * np.pi)
    along, e = r[:, :1], np.eye(d)
    potential = 1 / size if d == 3 else -np.log(size)
    u = factor * ((3 - 4 * law.nu) * potential * e[0] + r * along / size**d)
    # of 1/r and −log r: −r_j / r^d; of r_i r_1 / r^d the product rule
    slope = -r / size**d
    grad = (3 - 4 * law.nu) * e[0][None, :, None] * slope[:, None, :]
    s = size[:, :, None]
    grad = grad + (e[None] * along[:, :, None] + r[:, :, None] * e[0][None, None]) / s**d
    grad = grad - d * (r * along)[:, :, None] * r[:, None, :] / s ** (d + 2)
    return u, factor * grad


def kelvin_energy(panels, source, law, halvings=0):
    """∫u·σn over the surface, by the midpoint rule on panels that are cut into parts."""
    corners, normal = panels.corners, panels.directed
    for _ in range(halvings):
        corners = np.concatenate(_cuts(corners))
        parts = 2 ** (panels.dim - 1)
        normal = np.concatenate([normal / parts] * parts)
    u, grad = kelvin(corners.mean(axis=1), source, law)
    return float(np.einsum("ki,kij,kj->", u, law.stress(grad), normal))


def _cuts(corners):
    a, b = corners[:, 0], corners[:, 1]
    if corners.shape[1] == 2:
        m = 0.5 * (a + b)
        return [np.stack((a, m), axis=1), np.stack((m, b), axis=1)]
    c = corners[:, 2]
    p, q, r = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    parts = [(a, p, r), (p, b, q), (r, q, c), (q, r, p)]
    return [np.stack(part, axis=1) for part in parts]
