"""Arrays that grow at the end and are cut at the front, as history does."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class Column:
    """A NumPy array with amortised appends; ``view`` is the live part, (N, *shape).

    Rows of a view never change, except by writing to it."""

    def __init__(self, shape: tuple[int, ...] = (), dtype: DTypeLike = float) -> None:
        self._data: NDArray[Any] = np.zeros((16, *shape), dtype)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def view(self) -> NDArray[Any]:
        return self._data[: self._size]

    def extend(self, rows: NDArray[Any]) -> None:
        size = self._size + len(rows)
        if size > len(self._data):
            self._data = _roomy(self.view, size)
        self._data[self._size : size] = rows
        self._size = size

    def rearrange(self, first: int, rows: NDArray[np.int64]) -> None:
        """Replace everything from row ``first`` on by the given rows, in the given order; views keep the old rows."""
        self._data = self._data.copy()
        self._data[first : first + len(rows)] = self.view[rows]
        self._size = first + len(rows)

    def drop(self, count: int) -> None:
        """Drop the first ``count`` rows."""
        self._size -= count
        self._data = _roomy(self._data[count : count + self._size], self._size)


def _roomy(rows: NDArray[Any], size: int) -> NDArray[Any]:
    """The rows in a new array with room for ``size`` of them and some more."""
    room = np.zeros((size + size // 4 + 16, *rows.shape[1:]), rows.dtype)
    room[: len(rows)] = rows
    return room
