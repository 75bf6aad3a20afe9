"""What a diagnosis returns: facts of the log, size of the gap, verdict, text, traces."""
