"""What the paper names and leaves open, each option with its figures (docs/options.md)."""
