"""How large a table may be: larger ones are refused before they are read."""

from __future__ import annotations

MOST_BYTES = 512 * 2**20
"""Maximum size of a file."""

MOST_COLUMNS = 10_000

MOST_CELLS = 20_000_000
"""Maximum of the used columns: seven hours of four signals at 200 Hz, about 1.3 GB while they are read."""
