"""One table, three outputs: what the terminal, Markdown and HTML show of the same cells."""

import subprocess
import sys

from hil.table import Cell, Table


def table() -> Table:
    table = Table("", ("position [mm]", "RMS"), ("position [mm]", "max"), "why", left=(0, 3))
    table.add("estimate [a]", "0.1", Cell("22.5", alarm=True), Cell("a|b", note="x < y", code=True))
    return table


def test_the_terminal_shows_the_text_as_it_is(capsys):
    table().print()
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split("   ")[-3:] == [" position [mm] RMS", "position [mm] max", "why "]
    assert lines[3] == " estimate [a]                 0.1                22.5   a|b "


def test_a_long_word_is_folded_and_never_cut_off(capsys):
    faults = ",".join(f"base-tilt,axis=x,size_deg={n}" for n in range(9))
    table = Table("name", "faults", left=(0, 1))
    table.add("the base tilts", faults)
    table.print()
    assert "".join(line.removeprefix(" the base tilts").strip() for line in capsys.readouterr().out.splitlines()[3:]) == faults


def test_columns_are_aligned_as_they_say_and_an_alarm_is_bold_and_red():
    rich = table().rich()
    assert [column.justify for column in rich.columns] == ["left", "right", "right", "left"]
    assert [column.justify for column in Table("a", "b").rich().columns] == ["left", "right"]
    styles = [[str(cell.style) for cell in column.cells] for column in rich.columns]
    assert styles == [[""], [""], ["bold red"], [""]]


def test_a_table_can_be_printed_in_markdown(capsys):
    table().print(markdown=True)
    assert capsys.readouterr().out == table().markdown() + "\n"


def test_markdown_escapes_bars():
    assert table().markdown().splitlines() == [
        "|  | position [mm] RMS | position [mm] max | why |",
        "| --- | --- | --- | --- |",
        "| estimate [a] | 0.1 | 22.5 | `a\\|b` |",
    ]


def test_html_puts_groups_above_their_columns_and_escapes_text():
    html = table().html()
    assert '<tr><th rowspan="2"></th><th colspan="2">position [mm]</th><th rowspan="2">why</th></tr>' in html
    assert "</tr>\n<tr><th>RMS</th><th>max</th></tr>\n</thead>" in html
    assert "<tr><th>estimate [a]</th><td>0.1</td><td>22.5</td><td><code>a|b</code><small>x &lt; y</small></td></tr>" in html
    assert "rowspan" not in Table("a", "b").html()


def test_rich_is_imported_only_to_print():
    code = "import sys, hil.table; t = hil.table.Table('a'); t.add('b'); t.markdown(); t.html(); print('rich' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
