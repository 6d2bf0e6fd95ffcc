"""Pages wrap prose and nothing else, and what is written is whole and repeatable."""

import inspect
import json
import runpy
import shutil
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reporting.figure import drawing, label
from reporting.files import read_json
from reporting.machine import best_cpu_ms, commit, machine
from reporting.page import COLUMNS, page, publish
from reporting.table import table


@given(st.lists(st.text("abcdefgh", min_size=1, max_size=20), min_size=1, max_size=80))
def test_prose_keeps_its_words_and_fits_the_columns(words):
    text = page("# Title", " ".join(words))
    assert text.split() == ["#", "Title", *words]
    assert max(map(len, text.splitlines())) <= COLUMNS


@given(st.lists(st.sampled_from(["words", "16.", "2)", "-", "+", ">", "#", "%"]), min_size=1, max_size=80))
def test_no_line_of_prose_becomes_a_list_or_a_heading(words):
    first, *others = page(" ".join(["All", *words])).splitlines()
    assert first.startswith("All")
    assert not [line for line in others if line.split()[0] != "words"]


def test_tables_headings_pictures_and_lists_keep_their_lines():
    rows = table([("x" * 120,)], ("wide", 0))
    text = page(f"# {'long ' * 30}", rows, f"![{'a picture ' * 12}](p.png)", "- one\n- two\n  and a half")
    assert rows.markdown() in text
    assert "\n- one\n- two and a half\n" in text
    assert len(text.splitlines()[0]) > COLUMNS


def test_a_page_and_its_data_are_published_together(tmp_path):
    text = publish(tmp_path / "docs", "report", page("# Title"), {"a": [1, 2]})
    assert (tmp_path / "docs" / "report.md").read_text() == text == "# Title\n"
    assert read_json(tmp_path / "docs" / "report.json", "make report") == {"a": [1, 2]}
    assert len(list((tmp_path / "docs").iterdir())) == 2


@pytest.mark.parametrize("damage", [None, "{"])
def test_missing_and_damaged_data_name_the_file_and_the_command(tmp_path, damage):
    path = tmp_path / "report.json"
    if damage is not None:
        path.write_text(damage)
    with pytest.raises(ValueError, match=r"report\.json is .*make report"):
        read_json(path, "make report")


def test_the_same_figure_has_the_same_bytes_and_names_no_maker(tmp_path):
    for name in ("one.png", "two.png"):
        with drawing(tmp_path / name, 1, 2) as panels:
            panels[0, 0].plot([1, 2], [3, 4])
            panels[0, 0].set(xlabel="time, ms", ylabel="error, um", xlim=(0, 3), yscale="log")
            label(panels[0, 0], (1, 3), "a point")
        assert panels[0, 0].get_xlabel() == "time, ms"
        assert panels[0, 0].get_ylabel() == "error, um (log)"
    one = (tmp_path / "one.png").read_bytes()
    assert one == (tmp_path / "two.png").read_bytes()
    assert b"Software" not in one


def test_an_axis_that_hides_zero_says_so(tmp_path):
    with drawing(tmp_path / "figure.png") as panels:
        panels[0, 0].plot([0, 1], [90, 91])
        panels[0, 0].set(ylabel="right, %")
    assert panels[0, 0].get_ylabel() == "right, % (not from 0)"


def test_machine_and_commit_are_plain_data():
    assert json.loads(json.dumps(machine()))["cores"] >= 1
    assert commit()


@pytest.mark.skipif(shutil.which("git") is None, reason="no git here")
def test_the_commit_is_that_of_this_code_and_not_of_the_folder_around(tmp_path, monkeypatch):
    own = commit()
    named = ["-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "-q", "--allow-empty", "-m", "theirs"]
    for words in (["init", "-q"], named):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    monkeypatch.chdir(tmp_path)
    assert commit() == own
    installed = shutil.copy(str(inspect.getsourcefile(commit)), tmp_path)
    assert runpy.run_path(installed)["commit"]() == "unknown"


def test_the_fastest_call_counts():
    lengths = iter([40_000, 10, 40_000])
    once = best_cpu_ms(lambda: sum(range(100 * next(lengths))), 1)
    lengths = iter([40_000, 10, 40_000])
    assert best_cpu_ms(lambda: sum(range(100 * next(lengths))), 3) < 0.5 * once


def test_the_kit_is_light_until_it_draws():
    script = "import sys, reporting.page, reporting.figure, reporting.machine; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
