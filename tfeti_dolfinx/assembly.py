"""Compiled forms on the torn mesh, and their matrices."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.checks import checked_type, named
from tfeti_dolfinx.compat import JIT_OPTIONS, assemble_csr
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.form_checks import check_form, is_zero
from tfeti_dolfinx.mesh.decomposition import Decomposition


class Forms:
    """The compiled forms of a problem. Creation is collective.

    Args:
        a: Bilinear form.
        L: Linear form.
        V: The space of a.
        decomposition: The torn mesh.
        form_compiler_options: As in DOLFINx.
        jit_options: As in DOLFINx.

    Raises:
        InputError: A form cannot be integrated on the torn mesh, or not be compiled.
    """

    def __init__(
        self,
        a: ufl.Form,
        L: ufl.Form | ufl.ZeroBaseForm,
        V: fem.FunctionSpace,
        decomposition: Decomposition,
        form_compiler_options: Mapping[str, Any] | None,
        jit_options: Mapping[str, Any] | None,
    ) -> None:
        keywords = {
            "form_compiler_options": _options(form_compiler_options, "form_compiler_options"),
            "jit_options": {**JIT_OPTIONS, **_options(jit_options, "jit_options")},
        }
        for form, name in ((a, "a"), (L, "L")):
            check_form(form, name, V, decomposition)
        self._size = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
        self.a = _compiled(a, "a", decomposition, keywords)
        self.L = None if is_zero(L) else _compiled(L, "L", decomposition, keywords)

    def stiffness(self) -> Any:
        """This rank's K in DOLFINx's numbering, scipy CSR."""
        return assemble_csr(self.a)

    def load(self) -> Array:
        """This rank's f in DOLFINx's numbering."""
        if self.L is None:
            return np.zeros(self._size)
        return np.array(fem.assemble_vector(self.L).array)


def _options(given: Mapping[str, Any] | None, what: str) -> dict[str, Any]:
    if given is None:
        return {}
    checked_type(given, Mapping, what, "a dictionary")
    return dict(given)


def _compiled(
    form: ufl.Form, name: str, decomposition: Decomposition, keywords: dict[str, Any]
) -> fem.Form:
    """The form compiled by DOLFINx, which fails on all ranks or on none. Collective."""
    with raised_on_all_ranks(decomposition.comm), named(f"{name} cannot be compiled"):
        return fem.form(form, **keywords)
