"""The version of avtorch, which answers, pages and kept fits name."""

__version__ = "0.1.0"
