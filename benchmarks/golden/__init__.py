"""Golden answers: what a diagnosis engine says of fixed logs, kept as tables to compare the next engine with."""
