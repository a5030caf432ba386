"""The next pictures are decoded while networks look at the present ones.

The only thread of the offline stage. It produces what the loop would have produced itself, in the
same order, so results do not depend on it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def read_ahead(items: Iterable[T], count: int) -> Generator[T, None, None]:
    """The items (none of them None), up to `count` of them made ahead by a thread.

    What making an item raises is raised where that item is asked for.
    """
    source = iter(items)
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="read-ahead") as pool:
        waiting = deque(pool.submit(next, source, None) for _ in range(count))
        while (item := waiting.popleft().result()) is not None:
            waiting.append(pool.submit(next, source, None))
            yield item
