"""Identify a robot arm: from an arm on a bus to physically feasible dynamic parameters.

Importing this package loads no large library; its sub-packages load theirs when they are imported.
"""

__version__ = "0.1.0"
