"""Tables come out whole: every cell in its column, whatever it holds."""

import re

from hypothesis import given
from hypothesis import strategies as st

from reporting.statistics import wilson
from reporting.table import table

WORDS = st.text(st.characters(blacklist_categories=("Cs", "Cc", "Zl", "Zp"), blacklist_characters="\\"), max_size=12)


@given(st.lists(st.tuples(WORDS, st.floats(allow_nan=False, allow_infinity=False)), max_size=6), WORDS)
def test_every_markdown_line_has_as_many_cells_as_the_head(rows, title):
    lines = table(rows, (title, 0), ("number", 1, ".2f")).markdown().split("\n")
    assert len(lines) == 2 + len(rows)
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {3}


@given(WORDS)
def test_pipes_are_escaped_and_come_back(word):
    line = table([(word,)], ("word", 0)).markdown().split("\n")[2]
    assert line[2:-2].replace("\\|", "|") == word


def test_line_ends_do_not_break_a_row():
    assert table([("two\nlines",)], ("a", 0)).markdown().endswith("| two lines |")


def test_cells_are_read_by_name_by_path_by_index_and_by_function():
    row = {"name": "disk", "error": {"force_n": 0.5}, "right": list(wilson(9, 10)), "none": None, "many": [1.0, 2.5]}
    made = table(
        [row],
        ("name", "name"),
        ("force", "error.force_n", ".3f"),
        ("right", "right", ".0%"),
        ("none", "none", ".1f"),
        ("many", "many", ".1f"),
        ("twice", lambda row: 2 * row["name"]),
    )
    assert made.cells() == [["disk", "0.500", "90 % (60 .. 98)", "-", "1.0, 2.5", "diskdisk"]]
    assert "|---|---:|" in made.markdown().replace(" ", "")


def test_a_terminal_sees_aligned_columns():
    lines = table([("a", 1.0), ("long", 12.0)], ("name", 0), ("ms", 1, ".1f")).text().split("\n")
    assert lines == ["name    ms", "a      1.0", "long  12.0"]
