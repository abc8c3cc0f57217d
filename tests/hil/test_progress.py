"""Progress of work in parts."""

from hil.progress import part_of


def test_a_part_reports_its_share_of_the_whole():
    shares = []
    part = part_of(shares.append, 0.25, 0.5)
    for done in (0.0, 0.5, 1.0):
        part(done)
    assert shares == [0.25, 0.5, 0.75]
