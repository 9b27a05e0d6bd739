"""Shapes of obstacles, and checks of those that a user brings."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from tfeti_dolfinx.common.arrays import Array, ArrayLike, sum_rows
from tfeti_dolfinx.common.validation import (
    POSITIVE,
    checked_callable,
    checked_flag,
    checked_number,
    checked_type,
    checked_vector,
    named,
    real_numbers,
    shown,
    values_at,
)
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.gmsh_input import open_model
from tfeti_dolfinx.mortar.tolerances import SEARCH

# --- Shapes of rigid obstacles: signed distances ----------------------------------------------

Vector = tuple[float, ...] | list[float] | Array


class Shape(Protocol):
    """A rigid shape. Points come as in DOLFINx, shape ``(3, n)``, in 2D with z = 0.

    A node's gap is φ/‖∇φ‖ along −∇φ, so φ may be any level function; where ‖∇φ‖ ≠ 1 the gap is the
    distance to first order, exact where the shape is touched. Curvature is not asked for. A shape
    may have ``check_dimension(gdim, whose)``, which raises where it is not one of that dimension.
    """

    def distance(self, x: Array) -> Array:
        """Signed distance, positive on the free side, shape ``(n,)``."""

    def gradient(self, x: Array) -> Array:
        """Gradient of the signed distance, shape ``(3, n)``."""


def _vector(values: Vector, what: str) -> Array:
    """Return a vector of three components from two or three."""
    array = checked_vector(values, what, [2, 3], "two or three finite numbers")
    return np.pad(array, (0, 3 - len(array)))


def _direction(values: Vector, what: str) -> Array:
    vector = _vector(values, what)
    length = np.linalg.norm(vector)
    if length == 0.0:
        raise InputError(f"{what}={values}: expected a vector that is not zero")
    return vector / length


class Placed:
    """A shape that is placed by vectors of two or three components."""

    _vectors: dict[str, Vector]

    def check_dimension(self, gdim: int, whose: str) -> None:
        """Raise an InputError where a vector is plane in 3D, or points out of the plane in 2D."""
        for what, values in self._vectors.items():
            if len(values) == 2 and gdim == 3:
                raise InputError(f"{whose}: {what}={values}, expected three components in 3D")
            if len(values) == 3 and gdim == 2 and values[2] != 0.0 and what != "axis":
                raise InputError(f"{whose}: {what}={values}, expected two components in 2D")


class Plane(Placed):
    """A half space behind a plane.

    Args:
        point: A point of the plane.
        normal: Its normal, towards the free side; any length.

    Example:
        >>> floor = tfeti.Plane((0, -1), normal=(0, 2))
        >>> floor.distance(np.array([[0.5], [0.25], [0.0]])).tolist()
        [1.25]
    """

    def __init__(self, point: Vector, normal: Vector) -> None:
        self.point = _vector(point, "point")
        self.normal = _direction(normal, "normal")
        self._vectors = {"point": point, "normal": normal}

    def distance(self, x: Array) -> Array:
        """Signed distance, shape ``(n,)``."""
        return self.normal @ (x - self.point[:, None])

    def gradient(self, x: Array) -> Array:
        """Gradient of the signed distance, shape ``(3, n)``."""
        return np.repeat(self.normal[:, None], x.shape[1], axis=1)


class Sphere(Placed):
    """A ball (in 2D: a disc), or with ``inside`` a spherical cavity.

    Args:
        centre: The centre.
        radius: The radius.
        inside: Whether the bodies are inside the sphere.

    Example:
        >>> x = np.array([[3.0], [4.0], [0.0]])
        >>> tfeti.Sphere((0, 0, 0), radius=2.0).distance(x).tolist()
        [3.0]
        >>> tfeti.Sphere((0, 0, 0), radius=6.0, inside=True).distance(x).tolist()
        [1.0]
    """

    def __init__(self, centre: Vector, radius: float, inside: bool = False) -> None:
        self.centre = _vector(centre, "centre")
        self.radius = checked_number(radius, "radius", POSITIVE)
        self.sign = -1.0 if checked_flag(inside, "inside") else 1.0
        self._across = np.eye(3)  # what counts of an offset
        self._vectors = {"centre": centre}

    def distance(self, x: Array) -> Array:
        """Signed distance, shape ``(n,)``."""
        offset = self._across @ (x - self.centre[:, None])
        return self.sign * (np.linalg.norm(offset, axis=0) - self.radius)

    def gradient(self, x: Array) -> Array:
        """Gradient of the signed distance, shape ``(3, n)``; zero at the centre."""
        offset = self._across @ (x - self.centre[:, None])
        length = np.linalg.norm(offset, axis=0)
        return self.sign * offset / np.where(length > 0.0, length, 1.0)


class Cylinder(Sphere):
    """An infinite cylinder, or with ``inside`` a cylindrical bore.

    Args:
        point: A point of the axis.
        axis: Direction of the axis, any length.
        radius: The radius.
        inside: Whether the bodies are inside the cylinder.

    Example:
        >>> bore = tfeti.Cylinder((0, 0, 0), axis=(0, 0, 1), radius=6.0, inside=True)
        >>> bore.distance(np.array([[3.0], [4.0], [9.0]])).tolist()
        [1.0]
    """

    def __init__(self, point: Vector, axis: Vector, radius: float, inside: bool = False) -> None:
        super().__init__(_vector(point, "point"), radius, inside)
        self.axis = _direction(axis, "axis")
        self._across = np.eye(3) - np.outer(self.axis, self.axis)
        self._vectors = {"point": point, "axis": axis}


@dataclass(frozen=True)
class SignedDistance:
    """Any shape, by two callables of points of shape ``(3, n)``.

    Args:
        distance_of: Signed distance, positive on the free side, shape ``(n,)``.
        gradient_of: Its gradient, shape ``(3, n)`` (or ``(2, n)`` in 2D).

    Example:
        >>> bowl = tfeti.SignedDistance(
        ...     lambda x: x[1] - x[0] ** 2, lambda x: np.stack((-2 * x[0], np.ones_like(x[1])))
        ... )
        >>> bowl.gradient(np.array([[0.5], [1.0], [0.0]])).ravel().tolist()
        [-1.0, 1.0, 0.0]
    """

    distance_of: Callable[[Array], Array]
    gradient_of: Callable[[Array], Array]

    def __post_init__(self) -> None:
        expected = "a callable of points of shape (3, n)"
        checked_callable(self.distance_of, "distance_of", expected)
        checked_callable(self.gradient_of, "gradient_of", expected)

    def distance(self, x: Array) -> Array:
        """Signed distance, shape ``(n,)``."""
        return real_numbers(self.distance_of(x))

    def gradient(self, x: Array) -> Array:
        """Gradient of the signed distance, shape ``(3, n)``."""
        gradient = real_numbers(self.gradient_of(x))
        if gradient.ndim == 2 and len(gradient) == 2:
            return np.pad(gradient, ((0, 1), (0, 0)))
        return gradient


# --- Checks of a shape's callables ------------------------------------------------------------


def check_shape(shape: Any, what: str) -> None:
    """Raise an InputError unless an object has the two methods of a shape."""
    methods = [getattr(shape, name, None) for name in ("distance", "gradient")]
    if isinstance(shape, type) or not all(callable(method) for method in methods):
        raise InputError(
            f"{what}: shape is {shown(shape)}; expected a Plane, Sphere, Cylinder, SignedDistance, "
            "or an object with distance and gradient"
        )


def distance_and_gradient(shape: Shape, x: Array, what: str) -> tuple[Array, Array]:
    """Signed distance, ``(n,)``, and gradient, ``(n, 3)``, at points, ``(n, gdim)``."""
    n, gdim = x.shape
    if n == 0:
        return np.zeros(0), np.zeros((0, 3))
    points = np.zeros((n, 3))
    points[:, :gdim] = x
    distance = values_at(shape.distance, points.T, (n,), f"{what}: the distance at")
    return distance, values_at(shape.gradient, points.T, (3, n), f"{what}: the gradient at").T


def check_placement(
    shape: Shape, x: Array, gdim: int, what: str, size: float, comm: MPI.Intracomm
) -> None:
    """Raise if a shape is not one of this dimension, or its gradient not that of its distance.

    Collective. The gradient is compared with central differences of the distance at a few points of
    each rank: it is wrong where they differ by more than 60° or a factor of 100, since it may be
    rounded off or of any length. Wrong are most of them, or none. Points are those of the surface
    on this rank, shape ``(n, gdim)``; the size is that of the scene.
    """
    if callable(check := getattr(shape, "check_dimension", None)):
        check(gdim, what)
    with raised_on_all_ranks(comm), np.errstate(invalid="ignore"):  # of what is not finite
        phi, gradient = distance_and_gradient(shape, x, what)
        nearest = np.argsort(np.abs(phi))[: SEARCH.samples]
        x, gradient, step = x[nearest], gradient[nearest, :gdim], SEARCH.difference * size
        shifts = step * np.vstack((np.eye(gdim), -np.eye(gdim)))
        around, _ = distance_and_gradient(shape, (x + shifts[:, None]).reshape(-1, gdim), what)
        ahead, behind = around.reshape(2, gdim, len(x))
        slope = (ahead - behind).T / (2.0 * step)
        lengths = np.linalg.norm(gradient, axis=1), np.linalg.norm(slope, axis=1)
        product = lengths[0] * lengths[1]
        known = np.isfinite(product) & (product > 0.0)
        turned = np.sum(gradient * slope, axis=1) < SEARCH.same_direction * product
        scaled = np.maximum(*lengths) > SEARCH.same_length * np.minimum(*lengths)
        differs = known & (turned | scaled)
    wrong, compared = comm.allreduce(np.array([np.sum(differs), np.sum(known)]))
    with raised_on_all_ranks(comm):
        if 2 * wrong > compared and np.any(differs):
            i = int(np.argmax(differs))
            raise InputError(
                f"{what}: the gradient does not fit the distance; at {x[i].tolist()} "
                f"it is {gradient[i].tolist()}, expected about {slope[i].tolist()}"
            )


# --- Surfaces that are meshes: triangles in space, lines in the plane -------------------------


class SurfaceMesh:
    """A rigid shape with a surface of triangles, in 2D of lines.

    The distance is that from the nearest point of the surface. Its sign is that of the normal
    there: of a facet, or at an edge or a vertex the mean weighted by angles (Bærentzen, Aanæs,
    IEEE Trans. Vis. Comput. Graph. 11, 2005). Every rank has all of it.

    Args:
        points: Vertices, shape ``(n, 3)``, in 2D ``(n, 2)``; those in one place are joined.
        facets: Vertices of each facet, shape ``(f, 3)``, in 2D ``(f, 2)``. Seen from the free side
            triangles turn to the left; of lines the free side is to the right of the way from the
            first vertex to the second.

    Raises:
        InputError: The arrays do not fit, or no facet has an extent; those that have none, as
            programs for drawing write them, are left out.

    Example:
        >>> roof = tfeti.SurfaceMesh([(1, 0), (0, 1), (-1, 0)], [(0, 1), (1, 2)])
        >>> roof.distance(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 0.0]])).round(6).tolist()
        [2.0, -0.707107]
    """

    def __init__(self, points: ArrayLike, facets: ArrayLike) -> None:
        with named("SurfaceMesh: points", TypeError, ValueError):
            x = real_numbers(points)
        corners = np.asarray(facets)
        self._gdim = gdim = x.shape[-1] if x.ndim == 2 else 0
        if gdim not in (2, 3) or corners.ndim != 2 or corners.shape[1] != gdim or not len(corners):
            raise InputError(
                f"SurfaceMesh: points of shape {x.shape} and facets of shape {corners.shape}; "
                "expected (n, 3) and (f, 3), or (n, 2) and (f, 2)"
            )
        if not (np.issubdtype(corners.dtype, np.integer) and np.all(np.isfinite(x))):
            raise InputError("SurfaceMesh: expected finite points, and integers for facets")
        if corners.min() < 0 or corners.max() >= len(x):
            raise InputError(f"SurfaceMesh: facets name a vertex that is not among {len(x)}")
        size = float(np.ptp(x, axis=0).max())
        _, first, place = np.unique(
            np.round(x / (1e-9 * (size or 1.0))), axis=0, return_index=True, return_inverse=True
        )
        self._x, self._facets = x[first], place.ravel()[corners]
        self._find_normals()

    def _find_normals(self) -> None:
        """Find normals of facets, and those at vertices and edges, and the tree of middles."""
        c = self._x[self._facets]
        sides = np.roll(c, -1, axis=1) - c  # from each vertex to the next
        if self._gdim == 2:
            normal = np.stack((sides[:, 0, 1], -sides[:, 0, 0]), axis=1)
        else:
            normal = np.cross(sides[:, 0], sides[:, 1])
        length, longest = np.linalg.norm(normal, axis=1), np.linalg.norm(sides, axis=2).max(axis=1)
        wide = length > SEARCH.thin * longest ** (self._gdim - 1)
        if not np.any(wide):
            raise InputError("SurfaceMesh: no facet has an extent")
        self._facets, c, sides = self._facets[wide], c[wide], sides[wide]
        self._normal, angle = normal[wide] / length[wide, None], np.ones(self._facets.shape)
        if self._gdim == 3:
            along = sides / np.linalg.norm(sides, axis=2, keepdims=True)
            cosine = -np.sum(along * np.roll(along, 1, axis=1), axis=2)
            angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        vertices = np.repeat(self._normal[:, None], self._gdim, axis=1) * angle[:, :, None]
        self._of_vertex = sum_rows(
            self._facets.ravel(), vertices.reshape(-1, self._gdim), len(self._x)
        )
        if self._gdim == 3:  # edge i lies opposite of vertex i
            ends = np.sort(self._facets[:, [[1, 2], [2, 0], [0, 1]]], axis=2).reshape(-1, 2)
            _, edge = np.unique(ends, axis=0, return_inverse=True)
            edge = edge.ravel()
            total = sum_rows(edge, np.repeat(self._normal, 3, axis=0), int(edge.max()) + 1)
            self._of_edge = total[edge].reshape(-1, 3, 3)
        middle = c.mean(axis=1)
        self._radius = float(np.linalg.norm(c - middle[:, None], axis=2).max())
        self._tree = cKDTree(middle)

    def distance(self, x: Array) -> Array:
        """Signed distance, shape ``(n,)``."""
        return self._nearest(x)[0]

    def gradient(self, x: Array) -> Array:
        """Gradient of the signed distance, shape ``(3, n)``."""
        _, normal = self._nearest(x)
        found = np.zeros((3, len(normal)))
        found[: self._gdim] = normal.T
        return found

    def _nearest(self, x: Array) -> tuple[Array, Array]:
        """Return signed distances, and their gradients, shape ``(n, gdim)``."""
        p = np.ascontiguousarray(x[: self._gdim].T)
        if not len(p):
            return np.zeros(0), np.zeros((0, self._gdim))
        # 1. facets that may be nearest: their middle is no farther than the nearest point of the
        # nearest middle's facet, and the radius
        _, first = self._tree.query(p)
        own, _ = self._closest(p, np.atleast_1d(first))
        reach = np.linalg.norm(p - own, axis=1) + self._radius
        near = self._tree.query_ball_point(p, reach * (1.0 + 1e-9))
        counts = np.array([len(some) for some in near])
        facet = np.concatenate([np.asarray(some, dtype=np.int64) for some in near])
        point = np.repeat(np.arange(len(p)), counts)
        # 2. the nearest of them
        q, weight = self._closest(p[point], facet)
        apart = np.linalg.norm(p[point] - q, axis=1)
        order = np.lexsort((apart, point))
        best = order[np.concatenate(([0], np.cumsum(counts)[:-1]))]
        tie = apart <= (apart[best] + 1e-9 * self._radius)[point]
        mean = sum_rows(point[tie], (p[point] - q)[tie], len(p))
        q, weight, facet, apart = q[best], weight[best], facet[best], apart[best]
        # 3. the normal there, whose side says the sign
        normal, on = self._normal[facet].copy(), weight > 1e-9  # of a facet, an edge or a vertex
        count = on.sum(axis=1)
        at = np.flatnonzero(count == 1)
        normal[at] = self._of_vertex[self._facets[facet[at], np.argmax(on[at], axis=1)]]
        if self._gdim == 3:
            at = np.flatnonzero(count == 2)
            normal[at] = self._of_edge[facet[at], np.argmin(on[at], axis=1)]
        size = np.linalg.norm(normal, axis=1, keepdims=True)
        normal /= np.where(size > 0.0, size, 1.0)
        sign = np.where(np.sum((p - q) * normal, axis=1) < 0.0, -1.0, 1.0)
        far = apart > 1e-9 * self._radius
        # between facets that are as near and turn by little, the mean: rounding would choose one
        size = np.linalg.norm(mean, axis=1)
        little = np.sum(mean * (p - q), axis=1) > SEARCH.edge * size * apart
        along = np.where(little[:, None], mean, p - q) * sign[:, None]
        along /= np.where(far, np.where(little, size, apart), 1.0)[:, None]
        return sign * apart, np.where(far[:, None], along, normal)

    def _closest(self, p: Array, facet: Array) -> tuple[Array, Array]:
        """Return the points of facets that are nearest to p, and their barycentric coordinates."""
        c = self._x[self._facets[facet]]
        if self._gdim == 2:
            weight = _on_line(p, c[:, 0], c[:, 1])
            return np.einsum("nv,nvg->ng", weight, c), weight
        # inside, or on the nearest of the edges
        a, b, r = c[:, 1] - c[:, 0], c[:, 2] - c[:, 0], p - c[:, 0]
        aa, ab, bb = (np.sum(s * t, axis=1) for s, t in ((a, a), (a, b), (b, b)))
        ra, rb, det = np.sum(r * a, axis=1), np.sum(r * b, axis=1), aa * bb - ab**2
        s, t = (bb * ra - ab * rb) / det, (aa * rb - ab * ra) / det
        inside = np.stack((1.0 - s - t, s, t), axis=1)
        weights = [inside]
        for i, j in ((0, 1), (1, 2), (2, 0)):
            weight = np.zeros_like(inside)
            weight[:, [i, j]] = _on_line(p, c[:, i], c[:, j])
            weights.append(weight)
        tried = np.array(weights)
        places = np.einsum("knv,nvg->kng", tried, c)
        apart = np.linalg.norm(places - p, axis=2)
        apart[0, np.any(inside < 0.0, axis=1)] = np.inf
        best = np.argmin(apart, axis=0), np.arange(len(p))
        return places[best], tried[best]


def _on_line(p: Array, a: Array, b: Array) -> Array:
    """Barycentric coordinates of the points of lines that are nearest, shape ``(n, 2)``."""
    along = b - a
    t = np.clip(np.sum((p - a) * along, axis=1) / np.sum(along**2, axis=1), 0.0, 1.0)
    return np.stack((1.0 - t, t), axis=1)


def read_surface(path: str | os.PathLike[str], comm: MPI.Intracomm) -> SurfaceMesh:
    """Read a surface of triangles from an STL file, or a mesh of gmsh's, by rank 0. Collective.

    Args:
        path: A file that gmsh opens, ``.stl`` or ``.msh``.
        comm: Communicator.

    Raises:
        InputError: The file cannot be read, or has no triangles.
    """
    checked_type(path, (str, os.PathLike), "path", "the name of an STL file or a gmsh mesh")
    found: tuple[Array, Array] | None = None
    with raised_on_all_ranks(comm), named(f"cannot read {path}"):
        if comm.rank == 0:
            with open_model(Path(path)) as model:
                tags, x, _ = model.mesh.getNodes()
                _, corners = model.mesh.getElementsByType(2)
            if not len(corners):
                raise InputError(f"{path} has no triangles")
            place = np.zeros(int(tags.max()) + 1, dtype=np.int64)
            place[tags.astype(np.int64)] = np.arange(len(tags))
            found = x.reshape(-1, 3), place[corners.astype(np.int64)].reshape(-1, 3)
    points, facets = comm.bcast(found, root=0)
    with raised_on_all_ranks(comm), named(str(path)):
        return SurfaceMesh(points, facets)
