"""BoundedCache: keeps what was read last, up to a limit."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

__all__ = ["BoundedCache"]

Item = TypeVar("Item")


class BoundedCache(Generic[Item]):
    """Least recently used items go when their sizes exceed the limit; the newest always stays."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._total = 0
        self._items: OrderedDict[Hashable, tuple[Item, int]] = OrderedDict()

    def get(self, key: Hashable, read: Callable[[], Item], size: Callable[[Item], int]) -> Item:
        """The item of `key`; `read` makes it when it is not there, `size` says what it takes."""
        if key in self._items:
            self._items.move_to_end(key)
            return self._items[key][0]
        item = read()
        self._items[key] = (item, size(item))
        self._total += self._items[key][1]
        while self._total > self._limit and len(self._items) > 1:
            _, (_, freed) = self._items.popitem(last=False)
            self._total -= freed
        return item
