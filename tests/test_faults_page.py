"""The table of faults in the docs is what the source says."""

from faults_page import PAGE, page


def test_the_page_is_made_from_the_checks_and_most_faults_have_a_test():
    here, now = (text.splitlines()[9:] for text in (PAGE.read_text(), page()))
    assert messages(here) == messages(now), "uv run python tests/faults_page.py writes it anew"
    assert sum(".test_" in row for row in now) >= 60


def messages(rows):
    """Without the tests, which come and go."""
    return [row.rsplit(" | ", 1)[0] for row in rows]
