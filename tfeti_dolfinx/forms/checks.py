"""Checks of forms: arguments, coefficients, measures and tags on the torn mesh."""

from typing import Any

import basix
import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from ufl.algebra import Abs, Division, Power, Product, Sum
from ufl.algorithms import compute_form_data, extract_arguments
from ufl.algorithms.check_arities import ArityMismatch
from ufl.conditional import Conditional, MaxValue
from ufl.constantvalue import ScalarValue, Zero
from ufl.core.terminal import FormArgument
from ufl.corealg.traversal import traverse_unique_terminals, unique_post_traversal
from ufl.differentiation import Derivative
from ufl.geometry import SpatialCoordinate
from ufl.indexed import Indexed
from ufl.mathfunctions import Sqrt
from ufl.tensoralgebra import Dot, Inner
from ufl.variable import Variable

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.common.parallel import count_over
from tfeti_dolfinx.common.validation import checked_type, is_whole, named, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition, check_tags, known_tags
from tfeti_dolfinx.mesh.dofs import check_space, is_same_space, space_in_words
from tfeti_dolfinx.mesh.untorn import cell_facets

# linear forms, a load and a residual, and the bilinear ones beside them
LINEAR = {"L": "a", "F": "J"}
KINDS = {"cell": "dx", "exterior_facet": "ds", "interior_facet": "dS"}
# signatures of forms whose terms all have the same arguments: looking takes longer than assembly
# of some hundred unknowns, and DOLFINx needs the signature, too
_LINEAR_IN_ALL: set[str] = set()


def displacement_space(
    a: ufl.Form, decomposition: Decomposition, name: str = "a"
) -> fem.FunctionSpace:
    """Return the space of a bilinear form's trial and test functions. Collective."""
    with raised_on_all_ranks(decomposition.comm):
        test, trial = _argument_spaces(a, name, 2)
        check_space(test, decomposition)
    check_same_space(trial, test, f"the trial function of {name}", "that of its test function")
    return test


def check_form(form: Any, name: str, V: fem.FunctionSpace, decomposition: Decomposition) -> None:
    """Raise an InputError if space, coefficients, geometry, measures or tags of a form do not fit.

    Collective. Linear forms, ``"L"`` and ``"F"``, may be zero; bilinear ones are ``"a"`` and
    ``"J"``.
    """
    if name in LINEAR and is_zero(form):
        return
    with raised_on_all_ranks(decomposition.comm):
        spaces = _argument_spaces(form, name, 1) if name in LINEAR else []
    for space in spaces:
        check_same_space(space, V, f"the test function of {name}", f"that of {LINEAR[name]}")
    with raised_on_all_ranks(decomposition.comm):
        for integral in form.integrals():
            check_mesh(integral.integrand(), name, decomposition.mesh)
        _check_measures(form, name, decomposition)
    for integral in form.integrals():
        _check_tags(integral, name, decomposition)


def check_covered(
    a: ufl.Form, name: str, V: fem.FunctionSpace, decomposition: Decomposition
) -> None:
    """Raise an InputError if cells have unknowns that no integral of a bilinear form is over.

    Collective; it names their volumes.
    """
    integrals = a.integrals()
    tags = {t for i in integrals for t in np.atleast_1d(i.subdomain_id()).tolist()}
    if any(i.integral_type() != "cell" for i in integrals) or tags & {"everywhere", "otherwise"}:
        return
    cells, values = _tagged(integrals[0].subdomain_data(), "cell", decomposition, name)
    covered, dofs = np.zeros(len(decomposition.cell_subdomain), bool), V.dofmap.list
    covered[cells[np.isin(values, list(tags))]] = True
    left = ~covered & ~np.isin(dofs, dofs[covered]).all(axis=1)
    if count := count_over(decomposition.comm, left):
        own = np.unique(decomposition.cell_tags.values[left[decomposition.cell_tags.indices]])
        found = np.concatenate(decomposition.comm.allgather(own))
        volumes = {n: t for n, t in decomposition.names.volumes.items() if t in found}
        raise InputError(
            f"{name}: {count} cells are in no dx; expected one over all cells, volumes without it "
            f"are: {known_tags(volumes)}"
        )


def is_axisymmetric(form: Any, name: str, thickness: Any) -> bool:
    """Return whether a form has u_r/r, r = x[0]; raise an InputError if the thickness is 1 then.

    It may be u_r·(1/r) or u_r·r⁻¹, too. Derivatives of u over r are none, as where moduli are
    graded, nor is u over what is not 0 on the axis, as on a graded foundation.
    """
    ring = any(_has_hoop_strain(part.integrand()) for part in form.integrals())
    if ring and not isinstance(thickness, ufl.core.expr.Expr) and thickness == 1.0:
        raise InputError(
            f"{name} divides a displacement by a coordinate, as that of an axisymmetric body "
            "does, and thickness is 1: pressures would be forces per length; expected "
            "thickness=elastic.thickness, or what else the form was multiplied with"
        )
    return ring


def check_not_negative(
    value: Any, what: str, mesh: dmesh.Mesh, degree: int = 2, rounding: float = 1e-12
) -> None:
    """Raise an InputError if a scalar in UFL is negative or no number somewhere in a cell.

    Collective. It is asked, with its present constants and functions, at the corners of each cell
    and at the points of a quadrature of this degree; rounding is the share of the largest value
    that may be missing to 0.
    """
    cell_type = getattr(basix.CellType, mesh.topology.cell_type.name)
    inside, _ = basix.make_quadrature(cell_type, degree)
    points = np.vstack((basix.geometry(cell_type), inside))
    cells = np.arange(len(geometry_dofmap(mesh)), dtype=np.int32)
    with raised_on_all_ranks(mesh.comm), named(what):
        values = fem.Expression(value, points).eval(mesh, cells)
        values = np.asarray(values).reshape(len(cells), len(points))
        allowed = -rounding * np.abs(values).max(initial=0.0)  # 2πr on the axis
        wrong = ~(np.isfinite(values) & (values >= allowed))
        if np.any(wrong):
            cell, point = np.argwhere(wrong)[0]
            middle = mesh.geometry.x[geometry_dofmap(mesh)[cell]].mean(axis=0)
            at = middle[: mesh.geometry.dim].tolist()
            raise InputError(
                f"{what} is {values[cell, point]:.6g} in the cell around {at}; expected a "
                "positive number everywhere"
            )


def is_zero(form: Any) -> bool:
    """Return whether a form is one of UFL's zeros, which DOLFINx does not assemble."""
    if isinstance(form, ufl.Form):
        return all(isinstance(integral.integrand(), Zero) for integral in form.integrals())
    return isinstance(form, ufl.ZeroBaseForm) and len(form.arguments()) == 1


def checked_function(u: Any, V: fem.FunctionSpace, name: str) -> fem.Function:
    """Return a function of the space of a, checked. Collective."""
    checked_type(u, fem.Function, name, "a dolfinx.fem.Function on the space of a")
    check_same_space(u.function_space, V, name, "the space of a")
    return u


def check_same_space(V: Any, W: fem.FunctionSpace, what: str, whose: str) -> None:
    """Raise unless two spaces are the same, or equal in all but their names. Collective."""
    with raised_on_all_ranks(W.mesh.comm):
        if not isinstance(V, fem.FunctionSpace):
            raise InputError(f"{what} is from {shown(V)}; expected a dolfinx.fem.FunctionSpace")
        if V is W or is_same_space(V._cpp_object, W._cpp_object):
            return
        place = "" if V.mesh is W.mesh else " on another mesh"
        raise InputError(
            f"{what} is from {space_in_words(V._cpp_object)}{place}; expected {whose}, "
            f"{space_in_words(W._cpp_object)}"
        )


def check_mesh(expression: Any, name: str, mesh: dmesh.Mesh) -> None:
    """Raise if an expression takes functions or geometry from another mesh.

    Constants may be from any: they are numbers.
    """
    domain = mesh.ufl_domain()
    for term in traverse_unique_terminals(expression):
        for kind, expected in ((ufl.Coefficient, fem.Function), (ufl.Constant, fem.Constant)):
            if isinstance(term, kind) and not isinstance(term, expected):
                raise InputError(
                    f"{name}: {term} is a ufl.{kind.__name__}, which has no values; expected a "
                    f"dolfinx.fem.{expected.__name__}"
                )
        if not isinstance(term, ufl.Constant) and any(d != domain for d in term.ufl_domains()):
            what, how = f"{type(term).__name__} {term}", ""
            if isinstance(term, fem.Function):
                what = f"function {term.name!r}"
                how = ", where decomposition.from_original takes functions"
            raise InputError(
                f"{name}: the {what} is on another mesh (the one before decompose?); "
                f"expected decomposition.mesh, the torn mesh{how}"
            )


def _has_hoop_strain(integrand: Any) -> bool:
    """Return whether components of displacements, not derivatives, are multiplied with 1/r."""
    # of each part: whether such components are in it, and 1/r
    found: dict[Any, tuple[bool, bool]] = {}
    for part in unique_post_traversal(integrand):
        of = [found[operand] for operand in part.ufl_operands]
        moves, inverse = any(m for m, _ in of), any(r for _, r in of)
        if isinstance(part, Indexed) and isinstance(part.ufl_operands[0], FormArgument):
            moves = True  # a component; a load may be b·v/r
        elif isinstance(part, Derivative) and len(of) == 1:  # a gradient
            moves = inverse = False
        elif isinstance(part, Division) and _is_radius(part.ufl_operands[1]):
            if of[0][0]:
                return True
            inverse = True
        elif isinstance(part, Power) and isinstance(part.ufl_operands[1], ScalarValue):
            inverse |= float(part.ufl_operands[1]) < 0 and _is_radius(part.ufl_operands[0])
        elif isinstance(part, (Product, Dot, Inner)) and (
            (of[0][0] and of[1][1]) or (of[0][1] and of[1][0])
        ):
            return True
        found[part] = (moves, inverse)
    return False


def _is_radius(part: Any) -> bool:
    """Return whether an expression is 0 where x[0] is, or a tiny number there."""
    operands = part.ufl_operands
    if isinstance(part, Indexed) and isinstance(operands[0], SpatialCoordinate):
        return int(operands[1][0]) == 0
    if isinstance(part, Sum):
        tiny = [isinstance(o, ScalarValue) and abs(float(o)) < 1e-3 for o in operands]
        return all(_is_radius(o) or small for o, small in zip(operands, tiny, strict=True))
    kinds = (Product, Power, Abs, Sqrt, Variable, MaxValue, Conditional)
    return isinstance(part, kinds) and any(_is_radius(operand) for operand in operands)


def _argument_spaces(form: Any, name: str, arity: int) -> list[Any]:
    expected = f"a {'linear' if arity == 1 else 'bilinear'} form"
    if isinstance(form, fem.Form):
        raise InputError(f"{name} is a compiled form, dolfinx.fem.Form; expected UFL's own")
    if not isinstance(form, ufl.Form):
        hint = ", for no load ufl.ZeroBaseForm((v,))" if arity == 1 else ""
        raise InputError(f"{name} is {shown(form)}; expected {expected} of UFL{hint}")
    with named(f"{name} is not {expected}"):
        arguments = form.arguments()
    if len(arguments) != arity:
        hint = ", of a residual NonlinearContactProblem" if name == "a" and arguments else ""
        raise InputError(f"{name} has {len(arguments)} argument(s); expected {expected}{hint}")
    for integral in form.integrals():
        parts = {argument.number() for argument in extract_arguments(integral.integrand())}
        if missing := set(range(arity)) - parts:
            kind = ("test", "trial")[missing.pop()]
            raise InputError(f"{name}: an integral has no {kind} function; expected {expected}")
    with named(f"{name} is not {expected}"):  # DOLFINx would say so on one rank only
        try:
            if (signature := form.signature()) not in _LINEAR_IN_ALL:
                compute_form_data(form)
                _LINEAR_IN_ALL.add(signature)
        except ArityMismatch as error:  # a BaseException, which nobody else catches
            raise ValueError(error) from error
        except KeyError as error:  # what UFL numbers meshes by
            raise InputError(
                f"{name}: SpatialCoordinate, FacetNormal or the like is on another mesh than the "
                "measures (the one before decompose?); expected decomposition.mesh, the torn mesh"
            ) from error
    return [argument.ufl_function_space() for argument in arguments]


def _check_measures(form: ufl.Form, name: str, decomposition: Decomposition) -> None:
    data_of: dict[str, Any] = {}
    for integral in form.integrals():
        kind, data = integral.integral_type(), integral.subdomain_data()
        if kind not in KINDS:
            raise InputError(f"{name}: integrals of type {kind} are not supported; expected dx, ds")
        if integral.ufl_domain() != decomposition.mesh.ufl_domain():
            raise InputError(
                f"{name}: {KINDS[kind]} is on another mesh (the one before decompose?); expected "
                "decomposition.mesh, the torn mesh"
            )
        if kind == "interior_facet" and decomposition.is_torn:
            raise InputError("dS has no meaning across the tears of the mesh; use dx and ds(tag)")
        if data is None:  # all cells, else tags are missed
            continue
        if data_of.setdefault(kind, data) is not data:
            raise InputError(
                f"{name}: {KINDS[kind]} with different subdomain_data; expected one measure "
                f"{KINDS[kind]} in a form"
            )


def _check_tags(integral: Any, name: str, decomposition: Decomposition) -> None:
    tag, kind = integral.subdomain_id(), integral.integral_type()
    tags = tag if isinstance(tag, tuple) else (tag,)
    if "everywhere" in tags or "otherwise" in tags:
        if kind == "exterior_facet" and decomposition.is_torn:
            raise InputError(
                f"{name}: an untagged ds would integrate over the tears of the mesh; use "
                "ds(decomposition.surface(name)) with subdomain_data=decomposition.facet_tags"
            )
        return
    for t in tags:
        what = f"{name}: {KINDS[kind]}({t})"
        with raised_on_all_ranks(decomposition.comm), named(what):
            entities, values = _tagged(integral.subdomain_data(), kind, decomposition, what)
        entities = entities[values == t]
        outside = decomposition.boundary if kind == "exterior_facet" else entities
        inside = np.setdiff1d(entities, outside)
        count, wrong = decomposition.comm.allreduce(np.array([len(entities), len(inside)]))
        if count == 0:
            names = decomposition.names
            groups = names.volumes if kind == "cell" else names.surfaces
            raise InputError(
                f"{what}: nothing has this tag; the names and tags of the decomposition are: "
                f"{known_tags(groups)}"
            )
        if wrong:
            raise InputError(
                f"{what}: {wrong} of its facets lie inside a body; expected facets of the boundary "
                "only, such as of decomposition.facets(name) or "
                "decomposition.locate_facets(marker)"
            )


def _tagged(data: Any, kind: str, decomposition: Decomposition, what: str) -> tuple[Array, Array]:
    """Local cells or facets of a measure's data, and their tags."""
    name = "cell_tags" if kind == "cell" else "facet_tags"
    usual = f"expected subdomain_data=decomposition.{name}"
    if data is None:
        raise InputError(f"{what} without subdomain_data: {usual}")
    if isinstance(data, (list, tuple)) and kind != "interior_facet":
        return _listed(data, kind, decomposition, what)
    if not isinstance(data, dmesh.MeshTags):
        raise InputError(f"{what}: subdomain_data is {shown(data)}; {usual}")
    check_tags(data, decomposition.mesh, kind == "cell", f"{what}: subdomain_data", usual)
    return data.indices, data.values


def _listed(data: Any, kind: str, decomposition: Decomposition, what: str) -> tuple[Array, Array]:
    """The same of DOLFINx's lists of a tag and cells, or pairs of a cell and a local facet."""
    facets = cell_facets(decomposition.mesh)
    entities: list[Array] = [np.empty(0, np.int64)]
    values: list[Array] = [np.empty(0, np.int64)]
    for item in data:
        if not (isinstance(item, tuple) and len(item) == 2 and is_whole(item[0])):
            raise InputError(
                f"{what}: subdomain_data has {shown(item)}; expected tuples of a tag and an array"
            )
        found = np.asarray(item[1], dtype=np.int64).ravel()
        place = (found,) if kind == "cell" else (found[::2], found[1::2])
        if len(found) % len(place) or any(
            np.any((index < 0) | (index >= size))
            for index, size in zip(place, facets.shape, strict=False)
        ):
            raise InputError(
                f"{what}: subdomain_data of tag {item[0]} has entities that this rank has not; "
                "expected local cells, for ds each followed by its local facet"
            )
        entities.append(found if kind == "cell" else facets[place])
        values.append(np.full(len(entities[-1]), item[0]))
    tags = [tag for tag, _ in data]
    if tags != sorted(set(tags)):  # DOLFINx would integrate over some of them only
        raise InputError(
            f"{what}: subdomain_data has the tags {shown(tags)}; expected each once, in ascending "
            "order"
        )
    return np.concatenate(entities), np.concatenate(values)
