"""Robot identification service: from an arm on a bus to dynamic parameters a real body could have.

Importing this package loads no large library; each room below does that behind its own door.
"""

__version__ = "0.1.0"
