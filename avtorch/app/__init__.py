"""The workbench: `avtorch app`, a page on this machine for those who do not live in a terminal.

Each step runs the command that it shows, in the folder that it was started in; nothing is computed here otherwise but
the rollouts of a changed simulator. Needs `pip install 'avtorch[app]'`.
"""
