import threading

import pytest

from fusecap.batch.detect import read_ahead


def test_items_come_in_order_and_no_more_than_asked_for_are_made_ahead():
    made = []

    def numbers():
        for n in range(9):
            made.append(n)
            yield n

    found = []
    for n in read_ahead(numbers(), 2):
        found.append(n)
        assert made[-1] <= n + 2
    assert found == list(range(9))


def test_what_making_an_item_raises_comes_where_it_is_asked_for():
    def broken():
        yield 1
        raise ValueError("second")

    items = read_ahead(broken(), 3)
    assert next(items) == 1
    with pytest.raises(ValueError, match="second"):
        next(items)


def test_leaving_early_ends_the_thread():
    items = read_ahead(iter(range(100)), 2)
    assert next(items) == 0
    items.close()
    assert not any(t.name.startswith("read-ahead") for t in threading.enumerate())
