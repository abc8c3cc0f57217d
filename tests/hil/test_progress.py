"""Progress of work in parts: the shares come in order, and each part has its own."""

import pytest

from hil.progress import in_parts, part_of


def test_a_part_reports_its_share_of_the_whole():
    shares = []
    part = part_of(shares.append, 0.25, 0.5)
    for done in (0.0, 0.5, 1.0):
        part(done)
    assert shares == [0.25, 0.5, 0.75]


def test_equal_parts_come_in_order_and_end_at_one():
    shares, items = [], []
    for item, progress in in_parts("abcd", shares.append):
        items.append(item)
        for _, inner in in_parts((1, 2), progress):
            inner(0.5)
    assert items == list("abcd")
    # Of each part: half of its first half, all of that, half of the second, all of it, and the part itself.
    assert shares == pytest.approx([k / 4 + each for k in range(4) for each in (1 / 16, 1 / 8, 3 / 16, 1 / 4, 1 / 4)])
    assert list(in_parts([], shares.append)) == []
