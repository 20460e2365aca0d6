"""The thin top: command line, configuration files, the simulation from scene to report.

The only package that knows YAML, the command line and the layout of an output directory. Importing
it is cheap; every command imports what it needs when it runs.
"""
