"""Options that the paper names but does not work out, each with its figures (README.md)."""
