"""Text as recorders and spreadsheets write it: its encoding, its layout, its clocks."""
