"""The scripts that measure the tables of docs/ anew, on tiny pages with commands that print something."""

import json
import os
import re

import drift_table
import pytest
import update_figures
import yaml

from rcnn_odom.errors import InputError

SOURCE = re.compile(r"Commit abc1234, Intel Xeon \(AVX-512\), \d{4}-\d\d-\d\d, in \d+ s\.")
OLD = "| a |\n| --- |\n| 0 |\n\nCommit 1234567, processor not recorded, in 6 min 21 s."
PRINT_TABLES = r"""python -c "print('| a |\n| --- |\n| 1 |\n\n| b |\n| --- |\n| 2 |')" """


@pytest.fixture(autouse=True)
def machine(monkeypatch):
    """The tests need neither git nor a processor of this name."""
    monkeypatch.setattr(update_figures, "find_commit", lambda: "abc1234")
    monkeypatch.setattr(update_figures, "read_processor_name", lambda: "Intel Xeon (AVX-512)")


@pytest.fixture
def write_page(tmp_path):
    """Writes a page with a block of each of some commands, between two sentences."""

    def write(*commands, begin="figures:", name="page.md"):
        page = tmp_path / name
        blocks = (f"<!-- {begin} {one} -->\n\n{OLD}\n\n<!-- end of figures -->" for one in commands)
        page.write_text("\n\n".join(["Before.", *blocks, "After.\n"]))
        return page

    return write


def without_sources(text):
    """A page in which each source is one word."""
    return SOURCE.sub("SOURCE", text)


def test_tables_and_their_sources_take_the_place_of_what_was_there(write_page):
    page = write_page(PRINT_TABLES)
    assert update_figures.main([str(page)]) == 0
    assert without_sources(page.read_text()) == (
        f"Before.\n\n<!-- figures: {PRINT_TABLES} -->\n\n"
        "| a |\n| --- |\n| 1 |\n\nSOURCE\n\n| b |\n| --- |\n| 2 |\n\nSOURCE\n\n"
        "<!-- end of figures -->\n\nAfter.\n"
    )
    once = without_sources(page.read_text())
    assert update_figures.main([str(page)]) == 0
    assert without_sources(page.read_text()) == once


def test_one_table_of_several(write_page):
    page = write_page(PRINT_TABLES, begin="figures, table 2:")
    assert update_figures.main([str(page)]) == 0
    new = "-->\n\n| b |\n| --- |\n| 2 |\n\nSOURCE\n\n<!-- end"
    assert new in without_sources(page.read_text())


def test_other_text_is_a_block_of_code(write_page):
    page = write_page("""python -c "print('way  ms\\none  1.5')" """)
    assert update_figures.main([str(page)]) == 0
    assert "-->\n\n```\nway  ms\none  1.5\n```\n\nSOURCE\n\n<!-- end" in without_sources(page.read_text())


def test_long_lines_beside_tables_are_broken(write_page):
    page = write_page("""python -c "print('- ' + 'word ' * 40 + '\\n| ' + 'cell ' * 40 + '|')" """)
    assert update_figures.main([str(page)]) == 0
    lines = page.read_text().splitlines()
    assert any(line.startswith("  word") for line in lines)
    assert max(len(line) for line in lines if not line.startswith("|")) < 120
    assert "| " + "cell " * 40 + "|" in lines


def test_equal_commands_run_once_in_order_and_in_the_projects_folder(write_page, tmp_path):
    count = f"echo run >> '{tmp_path}/runs'; pwd"
    pages = [write_page(count, count), write_page(count, name="other.md")]
    assert update_figures.main([str(page) for page in pages]) == 0
    assert (tmp_path / "runs").read_text() == "run\n"
    for page in pages:
        assert str(update_figures.ROOT) in page.read_text()
        assert "| 0 |" not in page.read_text()


@pytest.mark.parametrize(
    ("begin", "commands", "message"),
    [
        ("figures:", "echo '| a |'; echo no recordings >&2; exit 3", "exit status 3: no recordings"),
        ("figures:", "false | echo '| a |'", "exit status 1: | a |"),
        ("figures:", "echo $NO_SUCH_VARIABLE", "NO_SUCH_VARIABLE: unbound variable"),
        ("figures:", "true", "printed nothing"),
        ("figures, table 3:", PRINT_TABLES, "table 3 of 2 is asked for"),
    ],
)
def test_a_page_whose_commands_fail_stays_as_it_was_and_others_are_measured(
    write_page, capsys, begin, commands, message
):
    page = write_page(PRINT_TABLES, commands, begin=begin)
    before, good = page.read_text(), write_page(PRINT_TABLES, name="good.md")
    assert update_figures.main([str(page), str(good)]) == 1
    assert page.read_text() == before
    assert "| 1 |" in good.read_text()
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{page} is left as it was: ")
    assert message in line


@pytest.mark.parametrize(
    "text",
    [
        "<!-- figures: echo a -->\n\n| a |\n",
        "| a |\n\n<!-- end of figures -->\n",
        "<!-- figures: echo a -->\n<!-- figures: echo b -->\n<!-- end of figures -->\n",
    ],
    ids=["no end", "no begin", "one end for two"],
)
def test_a_comment_without_its_counterpart_is_told(tmp_path, capsys, text):
    page = tmp_path / "page.md"
    page.write_text(text)
    assert update_figures.main([str(page)]) == 1
    assert "needs its '<!-- end of figures -->'" in capsys.readouterr().err
    assert page.read_text() == text


def test_what_is_written_into_the_page_meanwhile_stays(write_page):
    page = write_page("true")
    commands = f"echo '<p>New.</p>' >> '{page}'; echo '| a |'"
    page.write_text(page.read_text().replace("figures: true", f"figures: {commands}"))
    assert update_figures.main([str(page)]) == 0
    assert page.read_text().endswith("After.\n<p>New.</p>\n")
    assert "SOURCE" in without_sources(page.read_text())


def test_the_list_has_each_command_and_its_time_and_runs_none(write_page, tmp_path, capsys):
    page = write_page(f"touch '{tmp_path}/ran'\necho '| a |'")
    page.write_text(page.read_text() + "<!-- figures: echo b --><!-- end of figures -->")
    before = page.read_text()
    assert update_figures.main(["--list", str(page)]) == 0
    name = os.path.relpath(page)
    assert capsys.readouterr().out == (
        f"{name}, took 6 min 21 s the last time:\n    touch '{tmp_path}/ran'\n    echo '| a |'\n"
        f"{name}, not timed yet:\n    echo b\n"
    )
    assert page.read_text() == before
    assert not (tmp_path / "ran").exists()


def test_every_block_of_the_pages_says_where_its_tables_come_from():
    blocks = [
        block
        for page in sorted((update_figures.ROOT / "docs").glob("*.md"))
        for block in update_figures.find_blocks(page.read_text("utf-8"))
    ]
    assert len(blocks) > 5
    for block in blocks:
        tables = re.findall(r"(?:^\|[^\n]*\n)+|^```\n.*?^```\n", block["content"], re.M | re.S)
        sources = re.findall(r"^Commit [0-9a-f]{7,}[ ,]", block["content"], re.MULTILINE)
        assert len(sources) == len(tables) > 0, block["commands"]


def test_a_folder_that_git_does_not_know_leaves_the_page_as_it_was(write_page, monkeypatch, capsys):
    monkeypatch.setattr(update_figures, "find_commit", lambda: None)
    page = write_page(PRINT_TABLES)
    before = page.read_text()
    assert update_figures.main([str(page)]) == 1
    assert page.read_text() == before
    assert "run this in a checkout" in capsys.readouterr().err


def write_evaluation(folder, variant, options, drifts):
    """A folder as ``evaluate.py`` leaves it, with what the table reads."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(options))
    sequences = {name: {"drift": {"t_err": drift}} for name, drift in drifts.items()}
    (folder / "metrics.json").write_text(json.dumps({"variant": variant, "test": {"sequences": sequences}}))


def test_drifts_of_a_folders_evaluations(tmp_path):
    options = ["model=matcher", "data=blind", "run_dir=x"]
    write_evaluation(tmp_path / "z", "matcher", options, {"a": 0.0123, "b": None})
    write_evaluation(tmp_path / "y", "matcher", [*options, "data.deskew=on"], {"a": 1.5, "b": 0.1})
    for number, name in enumerate("zy"):
        os.utime(tmp_path / name / "metrics.json", (number, number))
    assert drift_table.table(tmp_path) == (
        "| drift in % | a | b |\n| --- | ---: | ---: |\n"
        "| matcher | 1.23 | - |\n| matcher data.deskew=on | 150.00 | 10.00 |"
    )


def test_evaluations_of_other_drives_or_none_are_refused(tmp_path):
    with pytest.raises(InputError, match="no evaluation in it"):
        drift_table.table(tmp_path)
    write_evaluation(tmp_path / "one", "matcher", [], {"a": 0.1})
    write_evaluation(tmp_path / "two", "matcher", [], {"b": 0.1})
    with pytest.raises(InputError, match="of other drives than"):
        drift_table.table(tmp_path)
