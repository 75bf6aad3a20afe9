"""How probable a log is under a candidate: records, noise made white, modes and their evidence."""
