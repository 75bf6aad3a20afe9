"""The notebooks as `.ipynb`, made of their sources: `python -m notebooks.pairing`, or `make notebooks`.

A source is a Python file in the percent format. Its pair beside it has the same cells, executed, with their outputs,
and is never edited by hand. What is written is the same on every run: no times, no random ids, no paths of a machine.
"""
