"""What a log holds before anything is estimated from it: its signals, its units, its recorder, what it can tell."""
