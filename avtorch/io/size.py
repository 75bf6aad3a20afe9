"""How large a table may be: what is larger is refused before it is read."""

from __future__ import annotations

MOST_BYTES = 512 * 2**20
"""Of a file."""

MOST_COLUMNS = 10_000

MOST_CELLS = 20_000_000
"""In the columns that are used: seven hours of four signals at 200 Hz, about 1.3 GB while they are read."""
