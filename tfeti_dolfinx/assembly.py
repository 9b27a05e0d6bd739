"""Forms on the torn mesh: what they may integrate over, and their matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.compat import JIT_OPTIONS, assemble_csr
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition


def check_measures(form: ufl.Form, decomposition: Decomposition) -> None:
    """Raise if a form integrates over the tears. Collective.

    Raises:
        InputError: The form has an interior facet integral, an untagged ``ds``, or a tagged one
            whose facets lie inside a body.
    """
    if not decomposition.is_torn:
        return
    for integral in form.integrals():
        kind = integral.integral_type()
        if kind.startswith("interior_facet"):
            raise InputError("dS has no meaning across the tears of the mesh; use dx and ds(tag)")
        if kind.startswith("exterior_facet"):
            _check_exterior(integral, decomposition)


def _check_exterior(integral: Any, decomposition: Decomposition) -> None:
    tag, data = integral.subdomain_id(), integral.subdomain_data()
    if tag in ("everywhere", "otherwise"):
        raise InputError(
            "an untagged ds would integrate over the tears of the mesh; use "
            "ds(decomposition.surface(name)) with subdomain_data=decomposition.facet_tags"
        )
    if not hasattr(data, "find"):
        return
    tags = tag if isinstance(tag, tuple) else (tag,)
    facets = np.concatenate([data.find(t) for t in tags])
    torn = np.intersect1d(facets, decomposition.tears)
    if count := decomposition.comm.allreduce(len(torn)):
        raise InputError(
            f"ds({tag}): {count} of its facets lie inside a body, on the tears of the mesh; "
            "expected facets of the boundary only"
        )


def displacement_space(a: ufl.Form) -> fem.FunctionSpace:
    """The space of a bilinear form's trial and test functions.

    Raises:
        InputError: The form is not bilinear on one space.
    """
    arguments = a.arguments()
    if len(arguments) != 2:
        raise InputError(f"a has {len(arguments)} arguments; expected a bilinear form")
    test, trial = (argument.ufl_function_space() for argument in arguments)
    if test != trial:
        raise InputError("trial and test functions of a are from different spaces")
    return test


class Forms:
    """The compiled forms of a problem. Creation is collective.

    Args:
        a: Bilinear form.
        L: Linear form.
        decomposition: The torn mesh.
        form_compiler_options: As in DOLFINx.
        jit_options: As in DOLFINx.
    """

    def __init__(
        self,
        a: ufl.Form,
        L: ufl.Form,
        decomposition: Decomposition,
        form_compiler_options: dict[str, Any] | None,
        jit_options: dict[str, Any] | None,
    ) -> None:
        for form in (a, L):
            check_measures(form, decomposition)
        keywords = {
            "form_compiler_options": form_compiler_options,
            "jit_options": {**JIT_OPTIONS, **(jit_options or {})},
        }
        self.a, self.L = fem.form(a, **keywords), fem.form(L, **keywords)

    def stiffness(self) -> Any:
        """This rank's K in DOLFINx's numbering, scipy CSR."""
        return assemble_csr(self.a)

    def load(self) -> Array:
        """This rank's f in DOLFINx's numbering."""
        return np.array(fem.assemble_vector(self.L).array)
