"""Common mistakes of a small function: the sources that the operators must make, by hand."""

import ast

import pytest

from falconwing_kit.tools.grading.mistakes import FIXES, HINTS, mistakes_of

FUNCTION = '''
def f(x, y, bank):
    """The docstring is no part."""
    total = 0.0
    for k in range(len(x)):
        if x[k] < y and bank > 0.0:
            total += x[k] ** 2 * np.sin(np.radians(bank))
    R = x @ y.T
    return np.sqrt(total), np.sum(R, axis=1), min(max(total, -y), y)
'''
TREE = ast.parse(FUNCTION).body[0]
FOUND = mistakes_of(TREE)
TEXTS = {each.source: each for each in FOUND}


@pytest.mark.parametrize(
    ("old", "new", "kind"),
    [
        ("x[k] ** 2 *", "x[k] *", "power"),
        ("np.sqrt(total)", "total", "power"),
        ("np.sin(", "np.cos(", "trigonometry"),
        ("np.radians(bank)", "bank", "units"),
        ("x[k] < y", "x[k] <= y", "comparison"),
        ("x[k] < y", "x[k] > y", "comparison"),
        ("x[k] < y and bank > 0.0", "x[k] < y or bank > 0.0", "condition"),
        ("x[k] < y and bank > 0.0", "bank > 0.0", "condition"),
        ("total += x", "total = x", "state"),
        ("range(len(x))", "range(len(x) + -1)", "index"),
        ("y.T", "y", "matrix"),
        ("x @ y.T", "y.T @ x", "matrix"),
        ("axis=1", "axis=0", "axis"),
        ("min(max(total, -y), y)", "max(total, -y)", "limit"),
        ("min(max(total, -y), y)", "total", "limit"),
        ("-y)", "y)", "sign"),
        ("np.sum(", "np.mean(", "function"),
        ("x @ y.T", "x @ x.T", "name"),
    ],
)
def test_the_mistakes_of_beginners_are_made(old, new, kind):
    """Each is written down by hand from the literature that the module names."""
    wanted = ast.unparse(ast.parse(FUNCTION.replace(old, new).replace('"""The doc', '"""D')))
    wanted = "\n".join(line for line in wanted.splitlines() if '"""' not in line).strip()
    assert TEXTS[wanted].kind == kind


def test_the_same_expression_is_also_changed_in_every_place():
    """`bank` stands twice: a student who thinks in degrees thinks so in every line."""
    source = FUNCTION.replace("bank > 0.0", "1 > 0").replace("return", "return np.radians(bank),")
    both = [each for each in mistakes_of(ast.parse(source).body[0]) if "radians" not in each.source]
    assert any(each.kind == "units" for each in both)


def test_mistakes_are_different_named_apart_and_of_a_kind_with_a_hint():
    """The function itself is none of them; every kind has a question and a way to mend it."""
    assert len(TEXTS) == len({each.name for each in FOUND}) == len(FOUND) > 100
    assert ast.unparse(TREE) not in TEXTS
    assert {each.kind for each in FOUND} <= HINTS.keys() == FIXES.keys()
    for each in FOUND:
        assert "np." not in each.name and "[" not in each.name, each.name


@pytest.mark.parametrize(
    ("right", "wrong", "kind"),
    [
        ("R.T @ (p - t)", "R.T @ p - t", "brackets"),
        ("a / (b * c)", "a / b * c", "brackets"),
        ("(a + b) / c", "a + b / c", "brackets"),
        ("(a - b) ** 2", "a - b ** 2", "brackets"),
        ("a * b / c * d", "a * d", "factor"),
        ("np.sqrt(np.mean(a))", "np.mean(np.sqrt(a))", "order"),
    ],
)
def test_brackets_products_and_nested_calls_go_wrong_as_on_paper(right, wrong, kind):
    """Each pair is algebra by hand: what is left when a bracket is opened too early."""
    source = "def f(a, b, c, d, R, p, t):\n    return "
    found = {each.source: each.kind for each in mistakes_of(ast.parse(source + right).body[0])}
    assert found[ast.unparse(ast.parse(source + wrong))] == kind
