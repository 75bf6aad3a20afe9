"""Detectors side by side: delay against false alarms, all judging the same beliefs."""
