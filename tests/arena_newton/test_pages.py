"""One table in three forms; text of others stays text in each."""

import pytest

from arena_newton.pages.tables import Table, between, percent, points

TABLE = Table(("task", "rate", "why"), (("a|b", 45.0, ""), ("_c", "-", "<b>")), "lrl", groups=(1,), name="A b")


def test_forms_of_a_table():
    """Even columns and compact ones in Markdown, CSV, and LaTeX with a rule above each group."""
    assert TABLE.markdown().splitlines() == [
        "| task | rate | why     |",
        "|------|-----:|---------|",
        "| a\\|b | 45.0 |         |",
        "| _c   |    - | &lt;b\\> |",
    ]
    assert Table(("", "n"), (("a|b", 3),), "lr").compact() == ["| | n |", "|---|--:|", "| a|b | 3 |"]
    assert Table(("n",), ((None,),)).csv() == 'n\n""\n'
    assert TABLE.csv() == "task,rate,why\na|b,45.0,\n_c,-,<b>\n"
    latex = TABLE.latex().splitlines()
    assert r"  \begin{tabular}{lrl}" in latex and r"  \label{table:--b}" in latex
    assert latex[latex.index(r"  a$|$b & 45.0 &  \\") + 1] == r"  \midrule"


def test_the_last_alignment_holds_for_all_that_follow():
    """`lr` is one column flush left and all others flush right, for any number of columns."""
    assert [Table(("x",) * n, (), "lr").columns for n in (1, 2, 4)] == ["l", "lr", "lrrr"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (percent(0.4567), "45.7"),
        (percent(0.4567, 0), "46"),
        (percent(None), "-"),
        (between((0.3, 0.625)), "30 to 62"),
        (between(None), "-"),
        (points(-0.042), "−4.2"),
        (points(-0.0001), "0.0"),
    ],
)
def test_figures_of_cells(text, shown):
    """Rates and intervals in per cent, differences in points; what is missing is a dash."""
    assert text == shown
