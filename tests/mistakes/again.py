"""Mistakes with what a problem takes for another solve."""

from mistakes.conditions import exterior

FLOOR = "obstacle of surface 'bottom'"


def updated(says, **made):
    """Solve, take what is made from the scene, solve again."""

    def do(s):
        problem = s.problem(contacts=[s.floor])
        problem.solve()
        problem.update(**{name: make(s) for name, make in made.items()})
        problem.solve()

    return do, says


def gaps(says, value):
    return updated(says, gap=lambda s: value)


def of_degree_2(s):
    return s.space("Lagrange", 2, (2,))


FORMS_AGAIN = {
    "a stiffness of another degree": updated(
        r"stiffness is from a space of degree 2 .*; expected a, a space of degree 1",
        stiffness=lambda s: s.a_on(of_degree_2(s)),
    ),
    "values on facets that are exterior to DOLFINx": updated(
        r"Dirichlet condition 0 prescribes 2 facets that lie on tears",
        values=lambda s: [exterior(s)],
    ),
}

GAPS_AGAIN = {
    "another gap without a contact": gaps(r"gap is \[0.1\]; expected a dictionary", [0.1]),
    "another gap of nobody": gaps(r"contact 'lid': there are 1, counted from 0", {"lid": 0.1}),
    "another gap of one contact twice": gaps(
        r"gap: contact 0 is there twice, by position and by name", {0: 0.1, FLOOR: 0.2}
    ),
}

TABLES = ("FORMS_AGAIN", "GAPS_AGAIN")
