"""How answers show themselves: a few lines in a console, a small table in a notebook, a data frame where one is wanted;
and how far a long call is.

Example:
    >>> from avtorch import Leader, simulate
    >>> log = simulate(Leader.default(start=30.0, duration=60.0, dt=0.05)).log()
    >>> print(log.overview().title)
    Log arrays: 1200 rows, 59.95 s at 20 Hz, 1 segment
    >>> log._repr_html_()[:5]  # what a notebook shows
    '<div>'
"""

from avtorch.display.frame import Card, Displayed, Frame, show
from avtorch.display.progress import progress_bar

__all__ = ["Card", "Displayed", "Frame", "progress_bar", "show"]
