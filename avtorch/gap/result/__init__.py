"""The result of a diagnosis: facts of the log, size of the gap, verdict, text, traces."""
