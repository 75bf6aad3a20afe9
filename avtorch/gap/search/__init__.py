"""Which candidates explain a log best: effects, pairs, onsets, and what chance decides."""
