"""What time_against_error.py solves: scenes, meshes, and the reference of each scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from benchmarks.error_case import QUADRILATERAL, TRIANGLE, Case
from benchmarks.error_scenes import ADAPTIVE, UNIFORM


@dataclass(frozen=True)
class Plan:
    """Cases of a scene.

    Attributes:
        cases: Groups of meshes.
        reference: The fine solution that errors are against.
        quick: Groups of a quick run.
        quick_reference: Its reference.
    """

    cases: tuple[Case, ...]
    reference: Case
    quick: tuple[Case, ...]
    quick_reference: Case


def label(case: Case) -> str:
    """A case in a few words."""
    words = [case.mesh, "" if case.cell == TRIANGLE else "quadrilaterals", f"P{case.degree}"]
    if case.degree == 2:
        words.append("curved" if case.order == 2 else "straight")
    words.append(f"{case.ranks} ranks" if case.ranks > 1 else "")
    return " ".join(word for word in words if word)


def case(name: str, sizes: tuple[float, ...], **other: Any) -> Case:
    """A case of degree 1; of degree 2 on curved cells if ``order=2``."""
    return Case(name, sizes, **other)


def both(name: str, linear: tuple[float, ...], order: int = 2, **other: Any) -> list[Case]:
    """Degree 1, and degree 2 on meshes that are twice as coarse."""
    quadratic = tuple(size / 2 for size in linear)
    return [
        case(name, linear, **other),
        case(name, quadratic, degree=2, order=order, **other),
    ]


def plan(name: str, cases: list[Case], finest: float, order: int = 2) -> Plan:
    """A plan with its quick form: the first two groups, their two coarsest meshes."""
    reference = case(name, (finest,), degree=2, order=order)
    quick = tuple(replace(one, sizes=one.sizes[:2]) for one in cases[:2])
    coarse = replace(reference, sizes=(quick[0].sizes[1],))
    return Plan(tuple(cases), replace(reference, rtol=1e-7), quick, coarse)


def _line() -> Plan:
    name, sizes = "half cylinder", (6.0, 12.0, 24.0, 48.0)
    cases = both(name, sizes)
    cases += both(name, sizes, order=1)[1:]
    cases += both(name, sizes, cell=QUADRILATERAL)
    cases += both(name, (1.0, 2.0, 4.0, 6.0), mesh=UNIFORM)
    cases.append(case(name, (0.3, 0.15, 0.08, 0.04), mesh=ADAPTIVE))
    cases += both(name, sizes, ranks=2)
    return plan(name, cases, 64.0)


def _ball() -> Plan:
    name, sizes = "half ball", (4.0, 6.0, 10.0, 16.0)
    cases = both(name, sizes[:3])
    cases[0] = case(name, sizes)
    cases += both(name, sizes[:3], order=1)[1:]
    cases.append(case(name, (0.6, 1.0, 1.5), mesh=UNIFORM))
    cases.append(case(name, (0.35, 0.25, 0.18), mesh=ADAPTIVE))
    cases += [replace(one, ranks=2) for one in cases[:2]]
    return plan(name, cases, 10.0)


def _half_planes(name: str) -> Plan:
    sizes = (6.0, 12.0, 24.0, 48.0)
    cases = both(name, sizes, order=1)
    cases.append(case(name, (1.0, 2.0, 4.0), mesh=UNIFORM))
    cases += both(name, sizes, order=1, ranks=2)
    return plan(name, cases, 64.0, order=1)


def _rings() -> Plan:
    name, sizes = "shrink fit", (8.0, 16.0, 32.0, 64.0)
    cases = both(name, sizes, mesh=UNIFORM)
    cases += both(name, sizes, mesh=UNIFORM, cell=QUADRILATERAL)
    cases += both(name, sizes, mesh=UNIFORM, ranks=2)
    return plan(name, cases, 90.0)  # of no mesh a refinement: their midpoints are better


def _cylinder() -> Plan:
    name, sizes = "cylinder on block", (6.0, 12.0, 24.0, 48.0)
    cases = both(name, sizes)
    cases += both(name, sizes, order=1)[1:]
    cases += both(name, sizes, cell=QUADRILATERAL)
    cases += both(name, (1.0, 2.0, 4.0), mesh=UNIFORM)
    cases += both(name, sizes, ranks=2)
    return plan(name, cases, 64.0)


PLANS = {
    "half cylinder": _line(),
    "half ball": _ball(),
    "rounded punch": _half_planes("rounded punch"),
    "partial slip": _half_planes("partial slip"),
    "shrink fit": _rings(),
    "cylinder on block": _cylinder(),
}
