"""Detectors compared: delay against false alarms, all on the same beliefs."""
