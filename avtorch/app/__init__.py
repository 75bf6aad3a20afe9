"""The workbench of `avtorch app`: each step runs the command that it shows, in the folder that it was started in."""
