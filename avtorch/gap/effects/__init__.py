"""The effects that the diagnosis can name, a file each; `avtorch.gap` fills its table of them.

Example:
    >>> from avtorch.gap import EFFECTS, DeadTime
    >>> len(EFFECTS), DeadTime.place, DeadTime.equation
    (25, 'command', 'u(t - tau)')
"""
