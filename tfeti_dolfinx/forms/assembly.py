"""Compiled forms on the torn mesh, their matrices, and whether their data has changed."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, ClassVar

import numpy as np
import ufl
from dolfinx import fem, la
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import assemble_csr
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.common.validation import checked_type, named
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.forms.checks import check_covered, check_form, is_zero
from tfeti_dolfinx.mesh.decomposition import Decomposition


@dataclass
class Data:
    """Data that a user may change, with a digest of their last values."""

    arrays: Callable[[], list[Array]]  # gives the numbers as they are now
    comm: MPI.Intracomm  # communicator
    seen: bytes = b""  # the digest

    def has_changed(self) -> bool:
        """Return whether data differ from the last call's, or this is the first. Collective."""
        digest = blake2b()
        for array in self.arrays():
            digest.update(np.ascontiguousarray(array))
        before, self.seen = self.seen, digest.digest()
        return any_rank(self.comm, before != self.seen)


def data_of(form: ufl.Form | ufl.ZeroBaseForm, V: fem.FunctionSpace) -> Data:
    """Return the constants and coefficients of a form whose arguments are on V."""
    if is_zero(form):
        return Data(lambda: [], V.mesh.comm)
    values, functions = form.constants(), form.coefficients()
    return Data(lambda: [*(c.value for c in values), *(f.x.array for f in functions)], V.mesh.comm)


@dataclass(frozen=True)
class Load:
    """A load in DOLFINx's numbering, this rank's part."""

    values: Array
    # what rounding may have made of each entry, if that is more than a share of it; else None
    rounding: Array | None = None
    given: Array = field(default_factory=lambda: np.zeros(0))  # then the part that is given


class Forms:
    """The compiled forms of a problem. Creation and all methods are collective.

    Creation raises an InputError where a form cannot be integrated on the torn mesh, or not be
    compiled.

    Attributes:
        names: Those of the bilinear and the linear form, for messages.
        has_mass: Whether bodies have mass, so that some may do without stiffness.
        given: The forms as they were given, by their names.
        thickness: What the forms were multiplied with, a number or a scalar in UFL; 1 until it is
            set.
        repeats: Whether the last look for changes has assembled a matrix with the entries of the
            one before, as of bodies that stay elastic.
    """

    repeats: bool = False
    _entries: la.MatrixCSR | None = None
    names: ClassVar[tuple[str, str]] = ("a", "L")
    has_mass: ClassVar[bool] = False

    def __init__(
        self,
        a: ufl.Form,
        L: ufl.Form | ufl.ZeroBaseForm,
        V: fem.FunctionSpace,
        decomposition: Decomposition,
        form_compiler_options: Mapping[str, Any] | None,
        jit_options: Mapping[str, Any] | None,
    ) -> None:
        self._V, self._decomposition = V, decomposition
        self.given: dict[str, Any] = {}
        self.thickness: Any = 1.0
        given = {"form_compiler_options": form_compiler_options, "jit_options": jit_options}
        for name, options in given.items():
            checked_type(options, (Mapping, type(None)), name, "a dictionary")
        self._keywords = {name: dict(options or {}) for name, options in given.items()}
        self._data = {"points": Data(lambda: [V.mesh.geometry.x], decomposition.comm)}
        self.replace_stiffness(a)
        self.replace_load(L)

    def replace_stiffness(self, a: ufl.Form) -> None:
        """Take another bilinear form on the same space."""
        name = self.names[0]
        check_form(a, name, self._V, self._decomposition)
        if not self.has_mass:
            check_covered(a, name, self._V, self._decomposition)
        self._a = self._compiled(a, name)
        self._assembled, self._entries = False, None
        self._data = {**self._data, "stiffness": data_of(a, self._V)}
        self.given = {**self.given, name: a}

    def replace_load(self, L: ufl.Form | ufl.ZeroBaseForm) -> None:
        """Take another linear form on the same space."""
        name = self.names[1]
        check_form(L, name, self._V, self._decomposition)
        self._L = None if is_zero(L) else self._compiled(L, name)
        self._data = {**self._data, "load": data_of(L, self._V)}
        self.given = {**self.given, name: L}

    def changes(self, *kept: str) -> set[str]:
        """Return which of ``points``, ``stiffness`` and ``load`` are new since they were asked for.

        Those of the mesh, and forms or what they refer to; ``kept`` ones are not asked for.
        """
        asked = {name: data for name, data in self._data.items() if name not in kept}
        return {name for name, data in asked.items() if data.has_changed()}

    def stiffness(self) -> Any:
        """Return this rank's K in DOLFINx's numbering, scipy CSR; the third on the second's data.

        Entries are kept where a form is assembled again: of one that is not, factors are enough.
        """
        A = self._entries or fem.create_matrix(self._a, la.BlockMode.expanded)
        self._assembled, self._entries = True, A if self._assembled else None
        return assemble_csr(self._a, A)

    def load(self) -> Load:
        """Return this rank's f."""
        return Load(self._linear())

    def _linear(self) -> Array:
        """Assemble this rank's part of the linear form."""
        if self._L is None:
            return np.zeros(self._V.dofmap.index_map.size_local * self._V.dofmap.index_map_bs)
        return np.array(fem.assemble_vector(self._L).array)

    def assembled(self, form: ufl.Form, name: str) -> Array:
        """Return the vector of a linear form, which is compiled for this call."""
        return np.array(fem.assemble_vector(self._compiled(form, name)).array)

    def _compiled(self, form: ufl.Form, name: str) -> fem.Form:
        """Return the form compiled by DOLFINx, which fails on all ranks or on none.

        DOLFINx takes the tags of one integral of a type for those of all.
        """
        comm, parts = self._decomposition.comm, form.integrals()
        data = {i.integral_type(): d for i in parts if (d := i.subdomain_data()) is not None}
        of_parts = [data.get(i.integral_type()) for i in parts]
        if any(i.subdomain_data() is not d for i, d in zip(parts, of_parts, strict=True)):
            pairs = zip(parts, of_parts, strict=True)
            form = ufl.Form([i.reconstruct(subdomain_data=d) for i, d in pairs])
        with raised_on_all_ranks(comm), named(f"{name} cannot be compiled"):
            return fem.form(form, **self._keywords)
